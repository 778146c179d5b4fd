"""Commands that start from a model: design, margins, export, firmware."""
