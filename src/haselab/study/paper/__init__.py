"""The reference paper: its printed results, checked and compared."""
