"""Models of structure from motion, moved onto the scan."""
