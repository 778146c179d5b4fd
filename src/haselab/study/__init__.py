"""A study as data and steps."""
