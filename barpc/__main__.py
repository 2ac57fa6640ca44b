"""`python -m barpc`."""

from barpc.cli import main

main()
