"""One thing that was looked at: its state, what was found and what to do; and all of them as text."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

Status = Literal["ok", "warning", "missing"]

_STYLES = {"ok": "green", "warning": "yellow", "missing": "bold red"}
_WIDTH = 110


@dataclass(frozen=True)
class Finding:
    """What was found.

    ``status`` is "missing" for what is required, or was asked for, and is not there or does not work; "warning" for
    what limits some of the work. Both come with ``advice``, one thing to do for each line.
    """

    subject: str
    status: Status
    found: str
    advice: str = ""


def print_findings(findings: Sequence[Finding], *, console: Console | None = None) -> None:
    """Print a table of the findings and, below it, what to do, in lines that can be copied."""
    if console is None:
        usual = Console()
        console = usual if usual.is_terminal and not usual.is_dumb_terminal else Console(width=_WIDTH)
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for heading in ("", "examined", "found"):
        table.add_column(heading, no_wrap=heading == "", overflow="fold")
    for each in findings:
        # Text, so that names from files are never taken for markup.
        table.add_row(Text(each.status, _STYLES[each.status]), Text(each.subject), Text(each.found))
    console.print(table)
    advised = [each for each in findings if each.advice]
    if advised:
        console.print("what to do", style="bold")
    for each in advised:
        lines = "".join(f"\n      {line}" for line in each.advice.splitlines())
        # Not wrapped: a command that is broken over two lines cannot be copied.
        console.print(Text(f"  {each.subject}:{lines}"), soft_wrap=True)
    missing = [each.subject for each in findings if each.status == "missing"]
    warnings = sum(each.status == "warning" for each in findings)
    said = f"missing: {', '.join(missing)}" if missing else "nothing that is required is missing"
    console.print(Text(f"{said}; {warnings} warning{'' if warnings == 1 else 's'}"), soft_wrap=True)
