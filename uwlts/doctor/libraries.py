"""Findings about Python, the required libraries, and the optional ones."""

import platform
import sys
from collections.abc import Iterable, Mapping, Sequence
from importlib import metadata

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from uwlts.doctor.machine import Finding
from uwlts.runtime.optional_library import EXTRAS, pip_install, read_requirements

_ABSENT = "not installed"


def examine() -> list[Finding]:
    """Python and all libraries."""
    python, required, extras = read_requirements()
    return [examine_python(python), *examine_required(required), *examine_optional(extras)]


def examine_python(wanted: str) -> Finding:
    """Examine whether this Python has a version like ``wanted``, such as ">=3.11"."""
    found = f"{platform.python_version()} on {platform.system()} {platform.machine()}, {sys.executable}"
    if not SpecifierSet(wanted).contains(platform.python_version(), prereleases=True):
        return Finding("Python", "missing", f"{found}; needed is {wanted}", f"install Python {wanted}")
    advice = "" if sys.platform == "linux" else "use Linux for cameras and stage: nothing else has been tried"
    return Finding.from_advice("Python", found, advice)


def examine_required(requirements: Sequence[str]) -> list[Finding]:
    """Examine whether libraries are installed in a suitable version.

    Returns one finding for all libraries without a fault, and one for every other.
    """
    examined = _examine_requirements(map(Requirement, requirements))
    good = ", ".join(f"{requirement.name} {version}" for requirement, version, fault in examined if not fault)
    findings = [Finding("required libraries", "ok", good)] if good else []
    for requirement, _, fault in examined:
        if fault:
            findings.append(Finding(requirement.name, "missing", fault, pip_install([str(requirement)])))
    return findings


def examine_optional(extras: Mapping[str, Sequence[str]], purposes: Mapping[str, str] = EXTRAS) -> list[Finding]:
    """Examine the libraries of each extra with a purpose; absent ones are optional, and others that fail a warning."""
    findings = []
    for extra, purpose in purposes.items():
        examined = _examine_requirements(map(Requirement, extras[extra]))
        texts = [f"{requirement.name} {fault or version}" for requirement, version, fault in examined]
        faults = {fault for _, _, fault in examined if fault}
        status = "ok" if not faults else "optional" if faults == {_ABSENT} else "warning"
        advice = f"only for {purpose}:\n{pip_install(extras[extra])}" if faults else ""
        findings.append(Finding(extra, status, f"{', '.join(texts)}; for {purpose}", advice))
    return findings


def _examine_requirements(requirements: Iterable[Requirement]) -> list[tuple[Requirement, str, str]]:
    """Return every library with its version and its fault, or an empty text."""
    states: list[tuple[Requirement, str, str]] = []
    for requirement in requirements:
        version = fault = ""
        try:
            version = metadata.version(requirement.name)
            if not requirement.specifier.contains(version, prereleases=True):
                fault = f"{version} is installed, {requirement.specifier} is needed"
        except metadata.PackageNotFoundError:
            fault = _ABSENT
        states.append((requirement, version, fault))
    return states
