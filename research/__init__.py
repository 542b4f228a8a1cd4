"""Compares methods on scenes with true poses; imports `piccolo`, and is not installed with it."""
