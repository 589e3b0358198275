"""The scenario of a drive: which area gets blocked and when, what an operator does, and how the drive went.

Pure, and the same for the demonstration, for lockstep runs and for the simulated robot of the compose file: the same
facts give the same hazard, the same commands and the same outcome.
"""
