"""Research datasets, read from their own folders and written as scenes with true poses."""
