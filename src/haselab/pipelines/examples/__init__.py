"""Example data sets, simulated by the twin when they are asked for."""
