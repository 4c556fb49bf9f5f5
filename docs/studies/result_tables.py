"""Tables of a study, with the command, commit and date of their measurement.

In a page of docs/results a table stands between its markers, ``<!-- results: NAME -->`` and ``<!-- end -->``.
"""

import re
import shlex
import subprocess
import sys
from datetime import date
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = ROOT / "docs" / "results"
CODE = ("uwlts", "twin", "scenes", "tests", "docs/studies", "docs/examples")
"""Folders whose uncommitted changes could change a figure."""


def table(head: list[str], rows: list[list[str]]) -> str:
    """Return a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def describe_measurement() -> str:
    """Return the line that precedes measured tables: today's date, the commit, and the command that runs."""
    spec = sys.modules["__main__"].__spec__
    program = f"-m {spec.name.removesuffix('.__main__')}" if spec else Path(sys.argv[0]).resolve().relative_to(ROOT)
    options = shlex.join(option for option in sys.argv[1:] if option != "--write")
    commit, changes = _git("rev-parse", "--short=7", "HEAD"), _git("status", "--porcelain", "--", *CODE)
    state = f"{commit}` with changes" if changes else f"{commit}`"
    return f"*Measured {date.today().isoformat()} at commit `{state}: `{f'python {program} {options}'.strip()}`.*"


def publish(tables: dict[str, str], *, write: bool) -> None:
    """Print tables, each below the line on its measurement, or put them between their markers in the pages."""
    for name, text in tables.items():
        block = f"<!-- results: {name} -->\n\n{describe_measurement()}\n\n{text}\n\n<!-- end -->"
        if not write:
            print(block, flush=True)
            continue
        marked = re.compile(rf"<!-- results: {re.escape(name)} -->.*?<!-- end -->", re.DOTALL)
        pages = {path: path.read_text(encoding="utf-8") for path in PAGES.glob("*.md")}
        count = sum(len(marked.findall(page)) for page in pages.values())
        if count != 1:
            raise SystemExit(f"error: {count} places for the table '{name}' in {PAGES}, expected one: add its markers")
        path, page = next((path, page) for path, page in pages.items() if marked.search(page))
        path.write_text(marked.sub(lambda _, block=block: block, page), encoding="utf-8")
        print(f"wrote the table '{name}' to {path.name}", flush=True)


def _git(*arguments: str) -> str:
    done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"error: no commit to name: {done.stderr.strip()}; run the study in a clone of the repository")
    return done.stdout.strip()
