"""Runs the ``uwlts`` command as ``python -m uwlts``."""

from uwlts.cli import main

main()
