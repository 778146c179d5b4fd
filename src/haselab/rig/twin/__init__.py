"""The simulated bench (twin), which implements the same protocols as real instruments."""
