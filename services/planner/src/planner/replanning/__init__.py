"""Missions: when a robot needs another path, and whether a path that was found replaces the current one. Pure."""
