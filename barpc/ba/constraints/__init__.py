"""What holds a block: observations, points, heights, earlier runs; where it starts, and how its place is known."""
