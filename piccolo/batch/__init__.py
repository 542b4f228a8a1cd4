"""Many photos: what is given, what answers them, and the file of results."""
