"""Serve the twin through the instruments' own protocols, on loopback."""
