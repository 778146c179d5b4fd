"""Named columns of numbers from files: CSV, MATLAB, NumPy, HDF5, TDMS."""
