"""The commands of the experiments, which `fognav` finds by entry points."""
