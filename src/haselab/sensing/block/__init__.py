"""Model of one block: segments, drive, tones, and unexplained blocks."""
