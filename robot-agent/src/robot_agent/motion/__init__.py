"""How it follows its path: path follower, and local planner with the dynamic window."""
