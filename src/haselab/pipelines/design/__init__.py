"""Controllers designed for the model of a file: reading both, margins, sections to write."""
