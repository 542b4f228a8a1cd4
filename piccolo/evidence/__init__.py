"""Evidence for and against a pose: made here, complete, for those who decide."""
