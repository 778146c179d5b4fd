"""Play experiments on a rig, close the loop, and record."""
