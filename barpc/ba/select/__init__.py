"""The model of a block: which terms, beside the cameras, its residuals ask for, and what is kept apart from it."""
