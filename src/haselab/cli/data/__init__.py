"""Commands that read recordings: sense, track, session, recover."""
