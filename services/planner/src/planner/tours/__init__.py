"""Missions with several stops in a running planner: in Redis, and over REST."""
