"""Many photos: their inputs, the loop that localizes them, and the file of results."""
