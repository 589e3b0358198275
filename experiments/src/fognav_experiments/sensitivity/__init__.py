"""How what the fog saves depends on its parts: debouncing, the nodes' period and number, the robot's speed."""
