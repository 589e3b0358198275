"""Maps from a robot's scans and odometry: a trajectory by scan matching, loops that close it, and the grid it shows."""
