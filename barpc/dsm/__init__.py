"""A first surface of a block, with its uncertainty: the proof of its cameras in metres on the ground."""
