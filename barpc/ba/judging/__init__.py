"""What is decided: which control agrees, which explanations win, and what of them the cameras follow."""
