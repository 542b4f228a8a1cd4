"""Point clouds: a reader for each format, then checks and an order common to all."""
