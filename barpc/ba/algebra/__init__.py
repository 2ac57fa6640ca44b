"""The linear algebra of blocks: who sees what, the order of elimination, and Cholesky in it."""
