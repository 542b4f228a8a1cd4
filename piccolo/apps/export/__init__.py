"""Results as files of other tools: a writer for each format, and the same checks for all."""
