"""What the commands share, and the body of each."""
