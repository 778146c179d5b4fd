"""Transfer functions in continuous time from records."""
