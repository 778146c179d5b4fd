"""`haselab doctor`: what is installed, which instruments answer, and how to fix the rest."""
