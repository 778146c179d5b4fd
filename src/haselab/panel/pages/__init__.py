"""What the pages of the panel show and do: studies, recordings, design, picking, doctor."""
