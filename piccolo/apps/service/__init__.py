"""A service that localizes photos sent by HTTP, and a page on which photos can be dropped."""
