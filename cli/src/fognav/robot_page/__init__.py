"""What a robot measures, live, and driving it by hand: on a page and in the terminal of its own computer."""
