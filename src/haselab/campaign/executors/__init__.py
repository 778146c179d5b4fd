"""Where cases are computed: processes of this computer, or Dask."""
