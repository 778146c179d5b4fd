"""Compute capacitance from the monitor voltages in a file."""
