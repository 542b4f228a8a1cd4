"""How kernels are compiled and run, and how files are written whole."""
