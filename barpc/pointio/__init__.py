"""Files of points: GCPs, tie points, correspondences of ground and image, and the names that they use for images."""
