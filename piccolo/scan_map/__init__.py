"""What is prepared of a scan once, its file, and what is looked up in it."""
