"""Drives on which something goes wrong, each described by a file with the outcome that is expected of it."""
