"""The solution of a block: its structure, normal equations and their factors, the minimum and its covariance."""
