"""Operating running systems from the command line: finding them, their REST APIs, and commands to their robots."""
