"""The ``uwlts`` command: the sensor's software, from captures to evaluated point clouds."""

import sys

# Importing them adds their commands.
from uwlts.cli import calibration, measuring
from uwlts.cli.options import app
from uwlts.runtime.console import run

__all__ = ["app", "calibration", "main", "measuring"]


def main() -> None:
    """Entry point."""
    sys.exit(run(app))
