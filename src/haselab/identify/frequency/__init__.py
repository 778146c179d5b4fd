"""Frequency responses and transfer functions fitted to them."""
