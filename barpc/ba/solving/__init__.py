"""How a block is solved: who sees what, its normal equations and their factors, the minimum and its covariance."""
