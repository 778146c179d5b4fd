"""Checks of every block and of the closed loop while a bench is energised."""
