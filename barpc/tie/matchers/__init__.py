"""Matchers of two views: keypoints, structure, given matches, a matcher of the user."""
