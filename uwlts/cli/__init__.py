"""The ``uwlts`` command: the sensor's software, from captures to evaluated point clouds."""

import sys

# Importing them adds their commands.
from uwlts.cli import calibration, describing, findings, measuring, recording
from uwlts.cli.options import app
from uwlts.runtime.console import run

__all__ = ["app", "calibration", "describing", "findings", "main", "measuring", "recording"]


def main() -> None:
    """Entry point."""
    sys.exit(run(app))
