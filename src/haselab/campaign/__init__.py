"""Campaigns: many cases of one kind, over parameters and seeds, on processes, Dask or Slurm."""
