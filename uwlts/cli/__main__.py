"""Runs the command as ``python -m uwlts.cli``."""

from uwlts.cli import main

main()
