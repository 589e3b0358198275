"""The laboratory's commands, which `fognav` finds by entry points."""
