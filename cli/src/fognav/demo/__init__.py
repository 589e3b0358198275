"""The demonstration: it starts the system, sends the robot to a goal, blocks its path, and evaluates the drive."""
