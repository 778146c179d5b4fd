"""haselab: the open bench for soft electrostatic actuators (HASEL, dielectric elastomers)."""

__version__ = "0.1.0"
