"""Obtains the library of Aravis, by which cameras are read and the twin plays one.

`python -m twin.devices.aravis_install` says which library is used, and obtains one first where there is none: with
apt-get as root, else unpacked from Debian's package or a wheel into a folder of one's own. Exit status 0, or 2 when
there is none.
"""

import sys

from twin.backend.packages import Report, obtain, obtain_by_command
from uwlts.runtime.shared_library import ARAVIS_VARIABLE, load_aravis, own_folders

DEBIAN_PACKAGE = "libaravis-0.8-0"
# Built by a third party for x86-64; GLib, libxml2 and libusb have to be there.
WHEEL = "aravis-python==0.8.31.post1"


def install_aravis(report: Report = lambda line: None) -> str:
    """Name of the library that is used; where there is none it is obtained, into `.aravis` or the user's cache folder.

    ``report`` is called with a line of text for each step. SetupError, with the reason of each, where none of the ways
    led to a library.
    """
    return obtain(
        lambda: load_aravis()._name,
        what="Aravis",
        choose=lambda options: [DEBIAN_PACKAGE],
        wheel=WHEEL,
        folders=own_folders("aravis"),
        choice=ARAVIS_VARIABLE,
        report=report,
    )


if __name__ == "__main__":
    sys.exit(obtain_by_command("Aravis", install_aravis))
