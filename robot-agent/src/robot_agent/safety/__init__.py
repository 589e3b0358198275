"""Whether it may move."""
