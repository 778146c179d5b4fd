"""Files: sessions, tables, videos, results."""
