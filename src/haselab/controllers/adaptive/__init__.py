"""Controllers that change with what they meet: a period, an operating point, a load."""
