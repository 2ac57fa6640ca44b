"""Model selection: terms beside the cameras, foreign cameras and moving ground."""
