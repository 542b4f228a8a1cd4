"""How kernels are compiled and run, and how files are read and written."""
