"""A seeded furnished room by ray casting: a world with known poses, for demo, tests and trying."""
