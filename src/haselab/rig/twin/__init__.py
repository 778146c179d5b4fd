"""The simulated bench: physics behind the same protocols as the instruments."""
