"""Hysteresis models from recorded loops."""
