"""A video to tracks, displacements and strain in a table."""
