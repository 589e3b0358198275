"""Missions that begin by the clock, and where a robot without one goes."""
