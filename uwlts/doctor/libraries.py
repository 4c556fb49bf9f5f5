"""Python, the libraries this project requires, and those that only some of its work needs."""

import platform
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

from uwlts.doctor.machine import Finding

PROJECT = "uwlts"
OPTIONAL = {
    "harvesters": "cameras with a GenTL producer, XIMEA's among them",
    "genicam": "cameras with a GenTL producer, XIMEA's among them",
    "laspy": "clouds as LAZ",
    "lazrs": "clouds as LAZ",
    "pye57": "clouds as E57",
    "dask": "sweeps on several machines",
    "distributed": "sweeps on several machines",
}
"""Optional libraries, with what they are needed for."""

_LOAD_S = 120
# What is begun last did not load, whether it raised an error or ended the process.
_LOAD = "import importlib, sys\nfor name in sys.argv[1:]: print(name, flush=True); importlib.import_module(name)"


def examine() -> list[Finding]:
    """Python and all libraries."""
    python, required, extras = project_requirements()
    return [examine_python(python), *examine_required(required), *examine_optional(OPTIONAL, requirements=extras)]


def project_requirements() -> tuple[str, list[str], list[str]]:
    """Versions of Python, required libraries and those of all extras, as this project's description lists them.

    In a checkout its pyproject.toml counts: the description that an editable installation keeps grows old.
    """
    file = Path(__file__).parents[2] / "pyproject.toml"
    if file.is_file():
        project = tomllib.loads(file.read_text(encoding="utf-8"))["project"]
        extras = [line for lines in project.get("optional-dependencies", {}).values() for line in lines]
        return project["requires-python"], project["dependencies"], extras
    installed = metadata.distribution(PROJECT)
    lines = [Requirement(line) for line in installed.requires or ()]
    applying = [line for line in lines if line.marker is None or line.marker.evaluate({"extra": ""})]
    others = [str(line).partition(";")[0] for line in lines if line not in applying]
    return installed.metadata["Requires-Python"], [str(line) for line in applying], others


def examine_python(wanted: str) -> Finding:
    """Whether this Python has a version as ``wanted``, such as ">=3.11"."""
    found = f"{platform.python_version()} on {platform.system()} {platform.machine()}, {sys.executable}"
    if not SpecifierSet(wanted).contains(platform.python_version(), prereleases=True):
        return Finding("Python", "missing", f"{found}; needed is {wanted}", f"install Python {wanted}")
    if sys.platform != "linux":
        return Finding("Python", "warning", found, "use Linux for cameras and stage: nothing else has been tried")
    return Finding("Python", "ok", found)


def examine_required(requirements: Sequence[str]) -> list[Finding]:
    """Whether libraries are there, in a suitable version, and can be imported.

    One finding for all that are as they should be, and one for every other.
    """
    faults, good = {}, {}
    for requirement in map(Requirement, requirements):
        version, fault = _version_and_fault(requirement)
        if fault is None:
            good[requirement.name] = version
        else:
            faults[requirement] = fault
    by_name = {requirement.name: requirement for requirement in map(Requirement, requirements)}
    for name, fault in _load_faults(list(good)).items():
        faults[by_name[name]] = f"{good.pop(name)} does not load: {fault}"
    found = [Finding("required libraries", "ok", ", ".join(f"{name} {good[name]}" for name in good))] if good else []
    for requirement, fault in faults.items():
        force = "--force-reinstall --no-deps " if "does not load" in fault else ""
        found.append(Finding(requirement.name, "missing", fault, _pip(f"{force}{shlex.quote(str(requirement))}")))
    return found


def examine_optional(purposes: Mapping[str, str], *, requirements: Sequence[str] = ()) -> list[Finding]:
    """Whether libraries are there that some work needs; ``purposes`` says which, by the library's name.

    A version counts where one of the ``requirements`` asks for it.
    """
    asked = {canonicalize_name(each.name): each for each in map(Requirement, requirements)}
    wanted = {name: asked.get(canonicalize_name(name), Requirement(name)) for name in purposes}
    states = {name: _version_and_fault(requirement) for name, requirement in wanted.items()}
    broken = _load_faults([name for name, (_, fault) in states.items() if fault is None])
    findings = []
    for name, (version, fault) in states.items():
        fault = f"{version} does not load: {broken[name]}" if name in broken else fault
        if fault is None:
            findings.append(Finding(name, "ok", f"{version}, for {purposes[name]}"))
        else:
            advice = f"only for {purposes[name]}:\n{_pip(shlex.quote(str(wanted[name])))}"
            findings.append(Finding(name, "warning", fault, advice))
    return findings


def _version_and_fault(requirement: Requirement) -> tuple[str, str | None]:
    try:
        version = metadata.version(requirement.name)
    except metadata.PackageNotFoundError:
        return "", "not installed"
    if not requirement.specifier.contains(version, prereleases=True):
        return version, f"{version} is installed, {requirement.specifier} is needed"
    return version, None


def _load_faults(names: Sequence[str]) -> dict[str, str]:
    """Why libraries cannot be imported, by their names; tried in another process, which may be ended by it."""
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
    """Names by which a library is imported; pyserial, for one, as serial."""
    usual = name.lower().replace("-", "_")
    files = [file.parts for file in metadata.files(name) or ()]
    packages = {parts[0] for parts in files if len(parts) == 2 and parts[1] == "__init__.py"}
    if usual in packages or not packages:
        return [usual]
    return sorted(package for package in packages if not package.startswith("_"))


def _pip(what: str) -> str:
    return f"{shlex.quote(sys.executable)} -m pip install {what}"
