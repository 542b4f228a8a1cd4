"""How far a pose can be trusted: score, alternatives, covariance, status."""
