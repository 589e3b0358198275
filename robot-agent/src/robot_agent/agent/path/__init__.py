"""Driving along the planner's path: mission, progress, recoveries, and the wheel commands. Pure."""
