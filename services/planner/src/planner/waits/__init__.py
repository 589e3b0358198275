"""How long things take: blocks of areas, and robots' ways; whether a robot waits before a block or goes round it."""
