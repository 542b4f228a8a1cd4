"""The prepared map of a scan, its file, and queries of it."""
