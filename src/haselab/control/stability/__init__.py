"""Stability margins, exact and on many plants."""
