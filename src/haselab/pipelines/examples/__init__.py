"""Example data sets, simulated by the twin on demand."""
