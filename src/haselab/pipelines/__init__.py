"""File-to-file jobs that the command line, the panel and notebooks call."""
