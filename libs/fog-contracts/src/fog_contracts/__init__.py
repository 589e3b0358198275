"""Channels, messages, cost values and grid geometry of Fognav, defined once."""
