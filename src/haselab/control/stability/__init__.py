"""Stability margins, exact, and for many plants."""
