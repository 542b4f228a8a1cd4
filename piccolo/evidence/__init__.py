"""The evidence for and against a pose: all of it is computed here, and the judge decides by it."""
