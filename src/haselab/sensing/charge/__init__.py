"""Capacitance without a carrier, from the charge."""
