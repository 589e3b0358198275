"""Path following: path follower, and local planner with the dynamic window."""
