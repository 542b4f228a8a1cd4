"""Scenes on disk with true poses, and what is done with many: datasets, evaluation, experiments, export."""
