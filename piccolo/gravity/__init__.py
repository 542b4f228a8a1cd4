"""The planes of a cloud, its vertical, which end of that is up, and the transform that turns it to z."""
