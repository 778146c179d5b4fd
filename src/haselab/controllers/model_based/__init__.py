"""Controllers that are synthesised from the identified model: predictive, H-infinity, polarity."""
