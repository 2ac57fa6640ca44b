"""One function a verb: what the command line calls, and `barpc.<verb>` in Python, with the flags as keywords."""
