"""Functions of the verbs, one each: `barpc.<verb>` in Python, with the flags as keywords; the CLI calls them."""
