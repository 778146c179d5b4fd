"""Monitor voltages in a file to capacitance in a table."""
