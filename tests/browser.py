"""Find and start the Chromium used by tests of web pages.

`python -m tests.browser` prints its path. The exit status is 0, or 1 if there is no Chromium.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from uwlts.errors import SetupError

if TYPE_CHECKING:
    from playwright.sync_api import Browser

VARIABLE = "CHROMIUM"
NAMES = ("chromium-headless-shell", "chromium", "google-chrome", "google-chrome-stable", "chromium-browser")
"""Names on PATH. On Ubuntu, chromium-browser is a script that asks for a snap; it is rejected."""
SOFTWARE_WEBGL = (
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-gpu-compositing",
)
"""WebGL by the processor, the same on machines with and without a graphics card."""
START_SECONDS = 60
"""Starting takes about 0.1 s; on a slow network drive much longer."""

_HOW_TO_INSTALL = f"""\
Install one:
  Debian:         apt-get install chromium-headless-shell fonts-dejavu-core   (as root)
  Fedora:         dnf install chromium   (as root)
  Arch:           pacman -S chromium   (as root)
  Ubuntu:         Google's package google-chrome-stable, as Ubuntu has Chromium only as a snap
or let the environment variable {VARIABLE} name a Chromium or Chrome."""


def find_chromium() -> Path:
    """Return the Chromium named by the variable CHROMIUM, otherwise one on PATH.

    Only a Chromium that starts is used. Otherwise raises SetupError with the findings and installation instructions.
    """
    if chosen := os.environ.get(VARIABLE):
        try:
            return _started(Path(shutil.which(chosen) or chosen).absolute())
        except SetupError as error:
            raise SetupError(f"the environment variable {VARIABLE} names {error}\n{_HOW_TO_INSTALL}") from error
    faults = ""
    for path in [Path(found) for found in map(shutil.which, NAMES) if found is not None]:
        try:
            return _started(path)
        except SetupError as error:
            faults += f"\n  {error}"
    raise SetupError(f"there is no Chromium for the tests of web pages. Found:{faults or ' none'}\n{_HOW_TO_INSTALL}")


def _started(path: Path) -> Path:
    """Return the path of a Chromium that starts, with all its libraries; SetupError if it does not start."""
    if not os.access(path, os.X_OK) or path.is_dir():
        raise SetupError(f"{path}: it is not there, or no program")
    try:
        started = subprocess.run([path, "--version"], capture_output=True, text=True, timeout=START_SECONDS)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise SetupError(f"{path}: it does not start: {error}") from error
    if started.returncode != 0:
        raise SetupError(f"{path}: it does not start: {started.stderr.strip()[-300:]}")
    if "chrom" not in started.stdout.lower():
        raise SetupError(f"{path}: it is no Chromium, it calls itself {started.stdout.strip()[:80]!r}")
    return path


@contextmanager
def open_chromium(path: Path) -> Iterator[Browser]:
    """Open a headless Chromium with software WebGL; Playwright's event loop runs in this thread.

    Chromium's sandbox is off, as usual with Playwright: it is not available to root and in most containers, and all
    pages are our own.
    """
    from playwright.sync_api import sync_playwright

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
    argparse.ArgumentParser(description="Print the Chromium in which tests open web pages.").parse_args()
    try:
        print(f"Chromium: {find_chromium()}")
    except SetupError as error:
        sys.exit(f"error: {error}")
