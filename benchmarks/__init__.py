"""Measurements of the published figures, compared with other libraries: `make bench`."""
