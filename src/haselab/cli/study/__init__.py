"""Commands that play and analyse studies: run, reproduce, analyse, report."""
