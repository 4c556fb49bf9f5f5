"""Finds, installs and starts the Chromium in which tests open web pages.

`python -m tests.browser` says which one is used, and obtains one first where there is none: with apt-get as root, else
unpacked from Debian's packages into a folder of one's own. Exit status 0, or 2 when there is none.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from twin.backend import packages
from twin.backend.llvm import RUNTIME_LIBRARY
from twin.backend.packages import Report, run_command
from uwlts.errors import SetupError
from uwlts.runtime.shared_library import file_of, own_folders

if TYPE_CHECKING:
    from playwright.sync_api import Browser

VARIABLE = "CHROMIUM"
NAMES = ("chromium-headless-shell", "chromium", "google-chrome", "google-chrome-stable", "chromium-browser")
"""Names on PATH. Ubuntu's chromium-browser is only a script that asks for a snap, and is refused where it is."""
DEBIAN_PACKAGES = ("chromium-headless-shell", "chromium")
DEBIAN_FONT = "fonts-dejavu-core"
"""Without any font a page shows no text."""
SOFTWARE_WEBGL = (
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-gpu-compositing",
)
"""WebGL by the processor, the same on machines with and without a graphics card."""
START_SECONDS = 60
"""Starting takes about 0.1 s; on a slow network drive much longer."""

# The start script and the settings of fonts lie in the unpacked tree and name what lies beside them.
_START = "start-chromium"
_SCRIPT = """\
#!/bin/sh
tree=$(dirname "$(readlink -f "$0")")
export LD_LIBRARY_PATH="{libraries}${{LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}}"
export FONTCONFIG_FILE="$tree/fonts.conf"
exec "$tree/{program}" "$@"
"""
_FONTS = """\
<?xml version="1.0"?>
<!DOCTYPE fontconfig SYSTEM "fonts.dtd">
<fontconfig>
  <include ignore_missing="yes">/etc/fonts/fonts.conf</include>
  <dir>/usr/share/fonts</dir>
  <dir prefix="relative">usr/share/fonts</dir>
  <cachedir prefix="xdg">fontconfig</cachedir>
</fontconfig>
"""
_HOW_TO_INSTALL = f"""\
Install one:
  Debian:         apt-get install chromium-headless-shell {DEBIAN_FONT}   (as root)
  Fedora:         dnf install chromium   (as root)
  Arch:           pacman -S chromium   (as root)
  Ubuntu:         Google's package google-chrome-stable, as Ubuntu has Chromium only as a snap
  without root:   python -m tests.browser   (on Debian)
or let the environment variable {VARIABLE} name a Chromium or Chrome."""


def find_chromium() -> Path:
    """The Chromium named by the variable CHROMIUM, else one on PATH, else one unpacked into an own folder.

    Only one that starts is taken. SetupError, with what was found and how to install one, where there is none.
    """
    if chosen := os.environ.get(VARIABLE):
        try:
            return _started(Path(shutil.which(chosen) or chosen).absolute())
        except SetupError as error:
            raise SetupError(f"the environment variable {VARIABLE} names {error}\n{_HOW_TO_INSTALL}") from error
    on_path = [Path(found) for found in map(shutil.which, NAMES) if found is not None]
    own = [folder / packages.TREE / _START for folder in own_folders("chromium")]
    faults = ""
    for path in [*on_path, *filter(Path.is_file, own)]:
        try:
            return _started(path)
        except SetupError as error:
            faults += f"\n  {error}"
    raise SetupError(f"there is no Chromium for the tests of web pages. Found:{faults or ' none'}\n{_HOW_TO_INSTALL}")


def _started(path: Path) -> Path:
    """The path of a Chromium that starts here, with all its libraries; SetupError where it does not."""
    if not os.access(path, os.X_OK) or path.is_dir():
        raise SetupError(f"{path}: it is not there, or no program")
    version = run_command([str(path), "--version"], seconds=START_SECONDS, shown=f"{path}: starting it")
    if "chrom" not in version.lower():
        raise SetupError(f"{path}: it is no Chromium, it calls itself {version.strip()[:80]!r}")
    return path


def install_chromium(report: Report = lambda line: None) -> Path:
    """Find a Chromium, or obtain one with its libraries and a font: with apt-get as root, else unpacked.

    ``report`` is called with a line of text for each step. It is unpacked into `.chromium` in the source tree, or the
    user's cache folder. SetupError, with the reason of each, where neither way led to one.
    """
    return packages.obtain(
        find_chromium,
        what="Chromium",
        choose=lambda options: [packages.first_offered(DEBIAN_PACKAGES, options), DEBIAN_FONT],
        place=_place,
        folders=own_folders("chromium"),
        choice=VARIABLE,
        report=report,
    )


def _place(unpacked: Path, target: Path) -> None:
    """Add a script that starts Chromium with the unpacked libraries and fonts, and move all of it into a folder."""
    programs = [f"usr/lib/chromium/{name}" for name in DEBIAN_PACKAGES]
    program = next((program for program in programs if (unpacked / program).is_file()), None)
    if program is None:
        raise SetupError(f"the packages contain none of {', '.join(programs)}")
    folders = sorted({library.parent.relative_to(unpacked).as_posix() for library in unpacked.rglob("lib*.so*")})
    libraries = ":".join(f"$tree/{folder}" for folder in folders)
    (unpacked / _START).write_text(_SCRIPT.format(libraries=libraries, program=program), encoding="utf-8")
    (unpacked / _START).chmod(0o755)
    (unpacked / "fonts.conf").write_text(_FONTS, encoding="utf-8")
    packages.move_tree(unpacked, target)


@contextmanager
def open_chromium(path: Path) -> Iterator[Browser]:
    """A headless Chromium with software WebGL, driven from this thread, in which Playwright's event loop then runs.

    As usual for Playwright, Chromium's sandbox stays off: root and most containers have none, and the pages are ours.
    """
    import pytest
    from playwright.sync_api import sync_playwright

    with pytest.MonkeyPatch.context() as patch:
        # Playwright's driver needs the same library as Dr.Jit, which lies in an own folder where the system lacks it.
        if library := next(filter(None, (file_of(RUNTIME_LIBRARY, folder) for folder in own_folders("llvm"))), None):
            patch.setenv("LD_PRELOAD", str(library), prepend=":")
        playwright = sync_playwright().start()
    try:
        browser = playwright.chromium.launch(executable_path=path, args=SOFTWARE_WEBGL)
        try:
            yield browser
        finally:
            browser.close()
    finally:
        playwright.stop()


if __name__ == "__main__":
    sys.exit(packages.obtain_by_command("Chromium", install_chromium))
