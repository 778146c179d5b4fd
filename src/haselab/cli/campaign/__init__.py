"""`haselab campaign`."""
