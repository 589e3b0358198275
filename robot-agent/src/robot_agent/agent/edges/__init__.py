"""The agent's connections: the guardian, the lidar, the map, its files, and Prometheus."""
