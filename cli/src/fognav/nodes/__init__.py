"""Sensor nodes from the command line: in the site's file, on the broker, and simulated."""
