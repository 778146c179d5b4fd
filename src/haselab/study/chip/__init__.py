"""Step experiments with the controller on a microcontroller."""
