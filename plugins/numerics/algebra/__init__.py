"""Small matrices and covariances."""
