"""The scan as it is seen from a place."""
