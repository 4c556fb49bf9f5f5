"""Findings about Python, the required libraries, and the optional ones."""

import platform
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from importlib import metadata

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from uwlts.doctor.machine import Finding
from uwlts.runtime.optional_library import EXTRAS, pip_install, read_requirements

_ABSENT = "not installed"
_LOAD_S = 120  # for all libraries, from a slow disk
# The last printed name is that of the module that did not load, by an error or by ending the process.
_LOAD = "import importlib, sys\nfor name in sys.argv[1:]: print(name, flush=True); importlib.import_module(name)"


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
    """Examine whether libraries are installed in a suitable version, and can be imported.

    Returns one finding for all libraries without a fault, and one for every other.
    """
    examined = _examine_requirements(map(Requirement, requirements))
    good = ", ".join(f"{requirement.name} {version}" for requirement, version, fault in examined if not fault)
    findings = [Finding("required libraries", "ok", good)] if good else []
    for requirement, _, fault in examined:
        if fault:
            force = ["--force-reinstall", "--no-deps"] if "does not load" in fault else []
            advice = pip_install([*force, str(requirement)])
            findings.append(Finding(requirement.name, "missing", fault, advice))
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
    broken = _load_faults([requirement.name for requirement, _, fault in states if not fault])
    for k, (requirement, version, _) in enumerate(states):
        if requirement.name in broken:
            states[k] = requirement, version, f"{version} does not load: {broken[requirement.name]}"
    return states


def _load_faults(names: Sequence[str]) -> dict[str, str]:
    """Return why libraries cannot be imported, by name; tested in a separate process, which a library may crash."""
    modules = {module: name for name in names for module in _modules(name)}
    faults, waiting = {}, list(modules)
    while waiting:
        command = [sys.executable, "-c", _LOAD, *waiting]
        try:
            trial = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=_LOAD_S)
        except subprocess.TimeoutExpired:
            return faults | {modules[waiting[0]]: f"it, or one after it, takes more than {_LOAD_S} s"}
        if trial.returncode == 0:
            break
        begun = [line for line in trial.stdout.splitlines() if line in waiting]
        said = trial.stderr.strip().splitlines() or [f"the process ended with status {trial.returncode}"]
        faults[modules[begun[-1]]] = said[-1]
        waiting = waiting[len(begun) :]
    return faults


def _modules(name: str) -> list[str]:
    """Return the module names of a library, such as serial for pyserial."""
    usual = name.lower().replace("-", "_")
    files = [file.parts for file in metadata.files(name) or ()]
    packages = {parts[0] for parts in files if len(parts) == 2 and parts[1] == "__init__.py"}
    if files and not any(parts[-1].endswith((".py", ".so", ".pyd")) and ".." not in parts for parts in files):
        return []  # a shared library, which is not imported
    if usual in packages or not packages:
        return [usual]
    return sorted(package for package in packages if not package.startswith("_"))
