"""How a block is solved: observations and priors as a problem, its normal equations, the minimum and its covariance."""
