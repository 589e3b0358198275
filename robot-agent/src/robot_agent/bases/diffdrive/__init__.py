"""A plain differential-drive board on a text protocol; README.md beside this file is its specification."""
