"""Slamtec RPLidar A1."""
