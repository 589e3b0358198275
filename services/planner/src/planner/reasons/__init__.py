"""Why there is no path: the hazards and zones behind lethal cells, and the refusals that name them. Pure."""
