"""A photo, what its file says, and the camera that took it."""
