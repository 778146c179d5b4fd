"""Text tables: their layout, numbers and clock times."""
