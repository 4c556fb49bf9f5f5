"""Findings about Python, libraries and the renderer, and their table."""

import platform
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from importlib.util import find_spec
from typing import Literal

from rich import box
from rich.table import Table
from rich.text import Text

from uwlts.runtime.optional_library import EXTRAS, pip_install, read_requirements

Status = Literal["ok", "optional", "warning", "missing"]

_STYLES = {"ok": "green", "optional": "dim", "warning": "yellow", "missing": "bold red"}


@dataclass(frozen=True)
class Finding:
    """Result of one examination.

    ``status`` is "missing" if something required, or named by the user, is absent or does not work, and "warning" if
    some features are limited. "optional" is absent, and only some features need it. All three come with ``advice``, one
    action per line.
    """

    subject: str
    status: Status
    found: str
    advice: str = ""

    @classmethod
    def from_advice(cls, subject: str, found: str, advice: str) -> "Finding":
        """Return a warning if there is advice, else ok."""
        return cls(subject, "warning" if advice else "ok", found, advice)


_ABSENT = "not installed"


def examine_libraries() -> list[Finding]:
    """Examine Python and all libraries; ImportError without the library packaging."""
    python, required, extras = read_requirements()
    return [examine_python(python), *examine_required(required), *examine_optional(extras)]


def examine_python(wanted: str) -> Finding:
    """Examine whether this Python has a version like ``wanted``, such as ">=3.11"."""
    from packaging.specifiers import SpecifierSet

    found = f"{platform.python_version()} on {platform.system()} {platform.machine()}, {sys.executable}"
    if not SpecifierSet(wanted).contains(platform.python_version(), prereleases=True):
        return Finding("Python", "missing", f"{found}; needed is {wanted}", f"install Python {wanted}")
    advice = "" if sys.platform == "linux" else "use Linux for cameras and stage: nothing else has been tried"
    return Finding.from_advice("Python", found, advice)


def examine_required(requirements: Sequence[str]) -> list[Finding]:
    """Return one finding for all installed libraries in a suitable version, and one for every other."""
    examined = [(line, *_examine_requirement(line)) for line in requirements]
    good = ", ".join(f"{name} {version}" for _, name, version, fault in examined if not fault)
    findings = [Finding("required libraries", "ok", good)] if good else []
    return findings + [
        Finding(name, "missing", fault, pip_install([line])) for line, name, _, fault in examined if fault
    ]


def examine_optional(extras: Mapping[str, Sequence[str]], purposes: Mapping[str, str] = EXTRAS) -> list[Finding]:
    """Examine the libraries of each extra with a purpose; absent ones are optional, and others that fail a warning."""
    findings = []
    for extra, purpose in purposes.items():
        examined = [_examine_requirement(line) for line in extras[extra]]
        texts = ", ".join(f"{name} {fault or version}" for name, version, fault in examined)
        faults = {fault for _, _, fault in examined if fault}
        status = "ok" if not faults else "optional" if faults == {_ABSENT} else "warning"
        advice = f"only for {purpose}:\n{pip_install(extras[extra])}" if faults else ""
        findings.append(Finding(extra, status, f"{texts}; for {purpose}", advice))
    return findings


def _examine_requirement(line: str) -> tuple[str, str, str]:
    """Return a required library's name, its version, and its fault, or an empty text."""
    from packaging.requirements import Requirement

    wanted = Requirement(line)
    try:
        version = metadata.version(wanted.name)
    except metadata.PackageNotFoundError:
        return wanted.name, "", _ABSENT
    if wanted.specifier.contains(version, prereleases=True):
        return wanted.name, version, ""
    return wanted.name, version, f"{version} is installed, {wanted.specifier} is needed"


_RENDERER_S = 330  # above the time that the program itself gives its trial


def examine_renderer() -> list[Finding]:
    """Examine whether the twin finds a libLLVM and can run a kernel with it; the twin is run as a separate program."""
    if find_spec("twin") is None:
        return [Finding("libLLVM", "ok", "not needed: the twin is not installed")]
    command = [sys.executable, "-m", "twin.backend.llvm"]
    try:
        asked = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=_RENDERER_S)
    except subprocess.TimeoutExpired:
        return [Finding("libLLVM", "warning", f"no answer within {_RENDERER_S} s", f"try: {shlex.join(command)}")]
    chosen = [line.removeprefix("chosen: ") for line in asked.stdout.splitlines() if line.startswith("chosen: ")]
    if asked.returncode == 0 and chosen:
        return [Finding("libLLVM", "ok", f"{chosen[0]}; a trial kernel ran")]
    said = asked.stderr.strip().splitlines() or [f"it ended with status {asked.returncode}"]
    # The program's own errors are most specific in the first line, tracebacks in the last.
    reason = said[0].removeprefix("error: ") if said[0].startswith("error: ") else said[-1]
    advice = f"only for rendering by the twin; how to install it says\n{shlex.join(command)}"
    return [Finding("libLLVM", "warning", f"the twin cannot render: {reason}", advice)]


def print_findings(findings: Sequence[Finding]) -> None:
    """Print a table of the findings, followed by the advice in lines that can be copied."""
    from uwlts.runtime.console import table_console

    console = table_console()
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for heading in ("", "examined", "found"):
        table.add_column(heading, no_wrap=heading == "", overflow="fold")
    for each in findings:
        # Text objects, so that names from files are not interpreted as markup.
        table.add_row(Text(each.status, _STYLES[each.status]), Text(each.subject), Text(each.found))
    console.print(table)
    advised = [each for each in findings if each.advice]
    if advised:
        console.print("what to do", style="bold")
    for each in advised:
        lines = "".join(f"\n      {line}" for line in each.advice.splitlines())
        # Not wrapped, so that commands can be copied.
        console.print(Text(f"  {each.subject}:{lines}"), soft_wrap=True)
    missing = [each.subject for each in findings if each.status == "missing"]
    warnings = sum(each.status == "warning" for each in findings)
    said = f"missing: {', '.join(missing)}" if missing else "nothing that is required is missing"
    console.print(Text(f"{said}; {warnings} warning{'' if warnings == 1 else 's'}"), soft_wrap=True)
