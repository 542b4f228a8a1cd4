"""The scan drawn from a position or at a pose."""
