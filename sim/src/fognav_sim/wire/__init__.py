"""Byte-exact stand-ins for the robot's devices, and the ptys on which they can be reached.

They share no code with the robot's drivers: two independent readings of the same data sheets keep each other honest.
"""
