"""Static maps and laws: stress and stretch, load, voltage, capacitance."""
