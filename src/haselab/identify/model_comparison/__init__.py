"""Which of several models a record supports."""
