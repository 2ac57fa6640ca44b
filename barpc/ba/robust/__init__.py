"""What is kept: weights, cuts, accuracies that are learnt, and what tracks that took no part say."""
