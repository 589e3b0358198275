"""What the robot itself knows: pose, base and lidar, and obstacles near it. Pure."""
