"""Pictures about points, brought onto each other: channels of gradients, registration, dense matching."""
