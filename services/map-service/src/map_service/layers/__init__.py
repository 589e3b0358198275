"""The layers of the costmap, one module each.

A layer marks the windows in which it changed and combines its costs into a window, on top of what the layers below it
wrote; it never lowers a cost. It registers a `LayerFactory` under its name in the entry points `fognav.cost_layers`;
a site chooses layers, bottom first, in `layers`. Inflation comes last and reads what all have written.
"""
