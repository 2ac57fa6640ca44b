"""Robust estimation: weights, rejection, estimated accuracies, and the residuals of check tie points."""
