"""Which directions of a lidar are those of the robot's travel, and how many of them it must see; without numpy."""

from __future__ import annotations

from typing import Final

SECTORS: Final = 72
"""Directions of the lidar, each 5 degrees wide, counter-clockwise from straight behind in `base`."""
TRAVEL_HALF_RAD: Final = 0.70
"""Directions this near to the heading are those of travel: a body of 0.17 m needs 40 degrees 0.26 m ahead."""
BLIND_SHARE: Final = 0.5
"""A robot does not drive where this share of the sectors of travel has no sample."""
