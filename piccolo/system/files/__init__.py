"""Reading and writing files that another process may read or write at once."""
