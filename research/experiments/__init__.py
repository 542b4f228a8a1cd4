"""Experiments: those of the paper, and the loss over a plan."""
