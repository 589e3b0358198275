"""The scenario of a drive: which area becomes blocked and when, what an operator does, and how the drive ended.

Pure, and shared by the demonstration, lockstep runs and the simulated robot of the compose file: the same inputs give
the same hazard, the same commands and the same outcome.
"""
