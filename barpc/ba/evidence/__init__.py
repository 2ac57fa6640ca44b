"""What ties show beside the cameras: stretches, periods, steps, and the evidence for what explains them."""
