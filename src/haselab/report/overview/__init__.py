"""What the page of a run shows first: the summary, the main numbers, and the groups of results."""
