"""Free oscillation after a mass is dropped."""
