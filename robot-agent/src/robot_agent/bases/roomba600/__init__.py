"""iRobot Roomba 600 and Create 2."""
