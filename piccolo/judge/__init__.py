"""Decisions: pure functions of candidates and probabilities."""
