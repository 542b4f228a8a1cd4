"""Trust in a pose: score, alternatives, covariance, status."""
