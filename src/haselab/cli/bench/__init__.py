"""Commands that work on a bench: rig, plan, calibrate, twin."""
