"""What keeps the core in step with the store, the map and the docks."""
