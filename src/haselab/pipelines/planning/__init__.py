"""The experiment that would determine a parameter of a physical model."""
