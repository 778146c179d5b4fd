"""`haselab identify`: models with uncertainty from recorded files."""
