"""For all rooms: errors, types of arrays, files, threads and processes, compiled kernels."""
