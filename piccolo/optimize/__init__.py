"""The sampling loss and the ways to descend on it."""
