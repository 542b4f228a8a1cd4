"""The default engine: a prepared map of views, one search over all of them, descent on normalised colours."""
