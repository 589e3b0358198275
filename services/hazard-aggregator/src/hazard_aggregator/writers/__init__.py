"""Changes of areas and overrides by operators: each is stored before it takes effect."""
