"""Obtains a libLLVM for Dr.Jit: as a system package where that is allowed, else unpacked into a folder of one's own."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path

from twin import packages
from twin.llvm_search import VARIABLE, LlvmLibrary, find_llvm, own_folders
from uwlts.errors import SetupError

# 19 first: the version that Dr.Jit 1.5.0 was measured with.
DEBIAN_PACKAGES = tuple(f"libllvm{major}" for major in (19, 22, 21, 20, 18, 17))
DEBIAN_RUNTIME = "libatomic1"
# A wheel that ships the shared library. Dr.Jit 1.5.0 renders with this version of it.
WHEEL = "karellen-llvm-core==23.1.4.post8"


def install_llvm(
    *,
    folders: Sequence[Path] | None = None,
    target: Path | None = None,
    report: Callable[[str], object] = lambda line: None,
) -> LlvmLibrary:
    """Find a suitable libLLVM, or obtain one: with apt-get as root, else unpacked from Debian packages or a wheel.

    Parameters
    ----------
    folders
        Where to look for one that is there already; without it everywhere.
    target
        Folder to unpack into; without it `.llvm` in the source tree, or the user's cache folder.
    report
        Called with a line of text for each step.

    Raises
    ------
    SetupError
        None of the ways led to a library; the message gives the reason of each.
    """
    return packages.obtain(
        lambda unpacked: find_llvm(None if folders is None else [*unpacked, *folders]), what="libLLVM",
        choose=_offered, wheel=WHEEL, target=target, folders=own_folders(), choice=VARIABLE, report=report,
    )  # fmt: skip


def _offered(options: Sequence[str]) -> list[str]:
    """The packages to take according to the package lists; SetupError where there is none."""
    package = _debian_package(options)
    if package is None:
        raise SetupError(f"apt-get: there is none of {', '.join(DEBIAN_PACKAGES)}")
    return [package, DEBIAN_RUNTIME]


def _debian_package(options: Sequence[str]) -> str | None:
    """The first of the packages that can be installed according to the package lists."""
    policy = packages.run_command(["apt-cache", *options, "policy", *DEBIAN_PACKAGES])
    offered = set(re.findall(r"^(\S+):\n  Installed: .*\n  Candidate: (?!\(none\))", policy, flags=re.MULTILINE))
    return next((package for package in DEBIAN_PACKAGES if package in offered), None)
