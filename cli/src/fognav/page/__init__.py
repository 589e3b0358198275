"""The demonstration in a browser: the map with everything that moves on it."""
