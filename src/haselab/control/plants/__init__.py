"""Plants in forms for the simulation of loops."""
