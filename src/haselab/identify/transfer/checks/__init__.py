"""Defects of a record that look like dynamics: clipping, spikes, clocks, ambiguous delays."""
