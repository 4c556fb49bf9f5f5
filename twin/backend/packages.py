"""System packages: libraries and programs that no wheel provides, installed by apt-get if this is root on Debian."""

import os
import shutil
import subprocess
import sys
from argparse import ArgumentParser
from collections.abc import Callable, Sequence
from functools import partial
from typing import TypeVar

from uwlts.errors import SetupError

COMMAND_SECONDS = 900
"""Downloads of some 100 MB over a slow line."""

Found = TypeVar("Found")
Report = Callable[[str], object]


def obtain(find: Callable[[], Found], packages: Sequence[str], report: Report = lambda line: None) -> Found:
    """Find a library or program, or install its Debian packages and find it then.

    Parameters
    ----------
    find
        Returns what is wanted, or raises a SetupError that says how to install it.
    packages
        Names of Debian packages.
    report
        Called with a line of text before the installation.

    Raises
    ------
    SetupError
        Nothing suitable was found, and the packages cannot be installed (no root, no apt-get) or do not help.
    """
    try:
        return find()
    except SetupError:
        if shutil.which("apt-get") is None or os.geteuid() != 0:
            raise
    report(f"installing {' '.join(packages)} (apt-get install)")
    install = ["apt-get", "install", "-y", "--no-install-recommends", "-o", "DPkg::Lock::Timeout=120", *packages]
    try:
        run_command(install)
    except SetupError:
        # Package lists that are missing or older than the archive name files that are not there.
        run_command(["apt-get", "update"])
        run_command(install)
    return find()


def run_as_command(what: str, install: Callable[[Report], object], words: Sequence[str]) -> int:
    """Run an installation from a command line without options; return the exit status: 0, or 2 with the reason."""
    ArgumentParser(description=f"Print which {what} is used, and install one first if there is none.").parse_args(words)
    try:
        print(f"{what}: {install(partial(print, flush=True))}")
    except SetupError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def run_command(command: Sequence[str], *, seconds: float = COMMAND_SECONDS, shown: str = "") -> str:
    """Run a command and return its standard output; raise SetupError, which calls it ``shown``, if it fails."""
    env = os.environ | {"LC_ALL": "C", "DEBIAN_FRONTEND": "noninteractive"}
    shown = shown or f"`{' '.join(command)}`"
    try:
        result = subprocess.run(
            command, env=env, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=seconds
        )
    except FileNotFoundError as error:
        raise SetupError(f"{command[0]} is not on this machine") from error
    except subprocess.TimeoutExpired as error:
        raise SetupError(f"{shown} did not end within {seconds} s") from error
    if result.returncode != 0:
        end = "\n  ".join((result.stderr or result.stdout).strip().splitlines()[-5:])
        raise SetupError(f"{shown} failed, exit status {result.returncode}:\n  {end}")
    return result.stdout
