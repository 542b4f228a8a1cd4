"""A service that localizes the photos which are sent to it, and the page on which they are dropped."""
