"""What finds the same ground in two views: keypoints, structure, given matches, a matcher of the user."""
