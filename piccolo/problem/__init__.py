"""The question: a photo's images, a map, and what is known beforehand."""
