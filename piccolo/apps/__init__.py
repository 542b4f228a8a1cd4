"""Applications: programs that are built upon the library, each with its commands; the rest imports none."""
