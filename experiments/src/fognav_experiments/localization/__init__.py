"""Evaluates the localization on recorded logs."""
