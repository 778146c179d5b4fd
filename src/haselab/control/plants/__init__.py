"""Plants in the form in which loops are simulated."""
