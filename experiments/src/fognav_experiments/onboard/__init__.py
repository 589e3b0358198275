"""Global planning on the robot itself, for the profiles that do without the fog's map and paths. Pure.

A robot finds the profiles by their entry points (`fognav.profiles`), and loads this when it is switched to one of them.
"""
