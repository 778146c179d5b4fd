"""Hysteresis models with inverses."""
