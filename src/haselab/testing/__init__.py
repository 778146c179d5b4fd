"""Checks for drivers in other packages: `haselab.testing.conformance`. Needs pytest."""
