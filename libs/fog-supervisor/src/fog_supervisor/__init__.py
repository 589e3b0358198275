"""Process supervision on one machine: programs with restarts, private servers and their configurations."""
