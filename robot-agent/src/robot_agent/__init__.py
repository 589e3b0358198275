"""Localizes, follows and drives; owns the safety gate and the serial port."""
