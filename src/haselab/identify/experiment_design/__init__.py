"""The next experiment: drives inside the limits of the bench, chosen by what they would show."""
