"""Installs the library of Aravis, by which cameras are read and the twin plays one.

`python -m twin.devices.aravis_install` prints the library in use, and installs it first by apt-get (as root) if it is
missing. Exit status 0, or 2 if there is none.
"""

import sys

from twin.backend.packages import Report, obtain, run_as_command
from uwlts.runtime.shared_library import load_aravis


def install_aravis(report: Report) -> str:
    """Return the name of Aravis's library, after installing it if it is missing; raise SetupError if it stays so."""
    return obtain(lambda: load_aravis()._name, ["libaravis-0.8-0"], report)


if __name__ == "__main__":
    sys.exit(run_as_command("Aravis", install_aravis, sys.argv[1:]))
