"""The fognav command."""
