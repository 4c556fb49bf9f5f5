"""Every module can be imported without the libraries of POSIX systems, as on Windows."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
HIDDEN = ("fcntl", "grp", "pty", "pwd", "resource", "termios", "tty")
# The renderer's modules need a variant of Mitsuba, which only Linux and macOS have set up here.
SCRIPT = f"""
import importlib, pkgutil, sys

HIDDEN = {HIDDEN!r}

class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name in HIDDEN:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

# What the interpreter and the libraries imported themselves is their own affair.
import matplotlib.figure, nicegui, numba, scipy.optimize, h5py, cyclopts, serial
for name in HIDDEN:
    sys.modules.pop(name, None)
sys.meta_path.insert(0, Hidden())
import uwlts, twin.devices
names = [name for package in (uwlts, twin.devices)
         for _, name, _ in pkgutil.walk_packages(package.__path__, package.__name__ + ".")]
for name in names:
    if not name.endswith("__main__"):
        importlib.import_module(name)
print(len(names))
"""


def test_every_module_can_be_imported_without_the_libraries_of_posix_systems():
    done = subprocess.run([sys.executable, "-c", SCRIPT], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 250
