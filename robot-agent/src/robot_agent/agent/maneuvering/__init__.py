"""Maneuvers beside the path: to the dock, out of a blocked area, straight back. Pure."""
