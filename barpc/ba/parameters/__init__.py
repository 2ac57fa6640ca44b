"""What is estimated: rotations, translations, drifts and splines of the cameras, and what is expected of them."""
