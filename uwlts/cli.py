"""The ``uwlts`` command: the sensor's software, from captures to judged point clouds."""

import sys

# Importing them adds their commands.
from uwlts.commands import calibration, design, files, measuring, recording, thesis, worth
from uwlts.commands.options import app
from uwlts.console import run

__all__ = ["app", "calibration", "design", "files", "main", "measuring", "recording", "thesis", "worth"]


def main() -> None:
    """Entry point."""
    sys.exit(run(app))


if __name__ == "__main__":
    main()
