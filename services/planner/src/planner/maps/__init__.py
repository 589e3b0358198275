"""The map that paths are planned on. Pure."""
