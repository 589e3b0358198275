"""Maneuvers beside the path: to the dock and off it, out of a blocked area, back from a bump, to look around. Pure."""
