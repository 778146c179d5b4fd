"""The twin behind the instruments' own protocols, on loopback."""
