"""What keeps the core in step with the store, the map, the docks and the metrics."""
