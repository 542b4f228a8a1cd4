"""Point clouds: a reader for each format, then the same checks and the same order of points for all."""
