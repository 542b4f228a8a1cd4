"""The prepared scan, its file, and lookups in it."""
