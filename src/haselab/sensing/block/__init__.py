"""The model of one block: segments, drive, tones, and what the model does not explain."""
