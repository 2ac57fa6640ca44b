"""The unknowns of the cameras: rotations, translations, drifts and splines, with their priors."""
