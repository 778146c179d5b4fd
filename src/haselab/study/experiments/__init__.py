"""The experiments of a study, and the analysis of each."""
