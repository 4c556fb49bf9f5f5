"""The ``uwlts`` command: the sensor's software, from captures to evaluated point clouds."""

import sys

# Their import registers the commands.
from uwlts.cli import calibrating, measuring, recording
from uwlts.cli.command_options import app
from uwlts.runtime.console import run

__all__ = ["app", "calibrating", "main", "measuring", "recording"]


def main() -> None:
    """Run the command line of this process."""
    sys.exit(run(app))
