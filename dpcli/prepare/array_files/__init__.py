"""Files of named arrays, in NumPy's, HDF5's and MATLAB's formats, and what their axes mean."""
