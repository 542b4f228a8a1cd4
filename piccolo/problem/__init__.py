"""What is asked: a photo's images, a map, and what is known beforehand."""
