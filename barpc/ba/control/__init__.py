"""Ground control points: which of them agree with each other, and tests of each against all others."""
