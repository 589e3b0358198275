"""How it follows its path."""
