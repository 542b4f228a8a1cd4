"""The losses, and the ways to descend on them."""
