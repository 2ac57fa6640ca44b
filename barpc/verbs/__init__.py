"""One function a verb, called by the command line and as `barpc.<verb>` in Python, with the flags as keywords."""
