"""The search of paths: A*, the distance fields that guide it, and ways out of blocked areas. Pure."""
