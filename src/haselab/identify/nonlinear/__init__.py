"""Nonlinear extensions of a transfer function."""
