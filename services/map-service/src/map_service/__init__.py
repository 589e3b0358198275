"""Turns hazards and no-go zones into one versioned master costmap."""
