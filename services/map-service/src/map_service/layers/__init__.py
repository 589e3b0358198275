"""The layers of the costmap, one module each.

A layer marks the windows in which its costs change, and combines its costs into a window on top of the layers below; it
never lowers a cost. It registers a `LayerFactory` under its name in the entry points `fognav.cost_layers`; a site lists
its layers, bottom first, in `layers`. Inflation is applied last, to the combined costs.
"""
