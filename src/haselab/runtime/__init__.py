"""Runs a protocol on a rig, closes the loop, keeps it safe."""
