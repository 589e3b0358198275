"""Robot bases, one folder each."""
