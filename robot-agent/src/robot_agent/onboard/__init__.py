"""Global planning on the robot itself, for the profiles that do without the fog's map and paths. Pure.

Only `robot_agent.agent.navigation` uses it, and loads it when such a profile is chosen.
"""
