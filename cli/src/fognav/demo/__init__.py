"""The demonstration: it starts everything, sends the robot on its way, blocks that way, and evaluates the drive."""
