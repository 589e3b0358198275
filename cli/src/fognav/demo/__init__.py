"""The demonstration: an operator who starts everything, sends the robot on its way, blocks that way, and judges."""
