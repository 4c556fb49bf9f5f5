"""Tables of docs/results: written by one command each, with date, commit and a digest of the code that they depend on.

    python -m docs.studies.result_tables [--write]      # list the tables whose code has changed since
    python -m docs.studies.result_tables --run          # make results: all tables by the code of this commit
    python -m docs.studies.result_tables --run --stale  # make results STALE=1: only those whose code has changed

``results.toml`` lists commands, tables, costs and folders of code. In a page, a table stands between its markers,
``<!-- results: NAME; code DIGEST -->`` and ``<!-- end -->``. Commands run in order of cost. A run that was stopped
continues with the next run, because tables that are up to date are left out.
"""

import hashlib
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date
from functools import cache
from pathlib import Path
from typing import Any

from cyclopts import App

ROOT = Path(__file__).resolve().parents[2]
PAGES = ROOT / "docs" / "results"
LIST = Path(__file__).with_name("results.toml")
FOLDERS = "runs/results/"
"""Folder of what studies render. A study's folder in it is removed when its code has changed."""
CODE = ("uwlts", "twin", "scenes", "tests", "docs/studies")
"""Folders whose uncommitted changes could change a figure."""
BLOCK = re.compile(r"<!-- results: ([^;\n]+?)(?:; code ([0-9a-f]{12}))? -->\n\n(.*?)\n\n<!-- end -->", re.DOTALL)
MEASURED = re.compile(r"^\*Measured (\S+) at commit `(\w+)`(?: with changes)?: `([^`]+)`\.\*$", re.MULTILINE)
PROSE = re.compile(rb'^ *(?:r?"""(?:[^"]|"(?!""))*"""|#.*)\n', re.MULTILINE)
"""Docstrings and comments. The digest is one of the code alone."""


@dataclass(frozen=True)
class Study:
    """Command that writes tables, minutes on two idle cores, folders of code that it depends on, commands before it."""

    command: str
    minutes: float
    tables: tuple[str, ...]
    code: tuple[str, ...]
    prepare: tuple[str, ...] = ()

    def digest(self) -> str:
        """Return a digest of the code of the study and of the folders that it depends on."""
        words = shlex.split(self.command)
        script = words[2].replace(".", "/") if words[1] == "-m" else words[1].removesuffix(".py")
        own = [f"{script}/__main__.py" if (ROOT / script).is_dir() else f"{script}.py"]
        return hashlib.sha256("".join(map(_digest, [*self.code, *own])).encode()).hexdigest()[:12]

    def stale(self, blocks: dict[str, tuple[Path, re.Match[str]]], commit: str = "") -> list[str]:
        """Return its tables that another command or other code wrote, or with a ``commit`` that of another one."""
        stale = []
        for name in self.tables:
            found = MEASURED.search(blocks[name][1][3])
            same = found and found[3] == self.command and blocks[name][1][2] == self.digest()
            if not (same and found and found[2].startswith(commit)):
                stale.append(name)
        return stale

    def run(self) -> None:
        """Run the commands; a folder of runs/results that they name is emptied if it is by other code."""
        for word in [word for word in shlex.split(self.command) if word.startswith(FOLDERS)]:
            folder = ROOT.joinpath(*Path(word).parts[:3])
            mark = folder / "code"
            if not mark.exists() or mark.read_text() != self.digest():
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir(parents=True)
                mark.write_text(self.digest())
        for command in (*self.prepare, f"{self.command} --write"):
            first, *words = shlex.split(command)
            program = [sys.executable] if first == "python" else [sys.executable, "-m", first]
            threads = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
            subprocess.run([*program, *words], cwd=ROOT, env=os.environ | threads, check=False)


@cache
def _digest(folder: str) -> str:
    path, total = ROOT / folder, hashlib.sha256()
    if not path.exists():
        raise SystemExit(f"error: {LIST.name} names the code {folder}, which does not exist")
    for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
        # Python and Numba keep compiled code beside the source.
        if file.is_file() and file.parent.name != "__pycache__":
            total.update(str(file.relative_to(ROOT)).encode() + b"\n" + PROSE.sub(b"", file.read_bytes()))
    return total.hexdigest()


def read_studies() -> list[Study]:
    """Return all studies, the cheapest first."""
    listed: dict[str, Any] = tomllib.loads(LIST.read_text(encoding="utf-8"))
    groups: dict[str, list[str]] = listed["code"]
    studies = []
    for each in listed["study"]:
        code = [folder for name in each.pop("code") for folder in groups.get(name, [name])]
        lists = {key: tuple(each.pop(key)) for key in ("tables", "prepare") if key in each}
        studies.append(Study(code=tuple(dict.fromkeys(code)), **lists, **each))
    return sorted(studies, key=lambda study: study.minutes)


def read_blocks() -> dict[str, tuple[Path, re.Match[str]]]:
    """Return page and text of each marked table by its name."""
    found: dict[str, tuple[Path, re.Match[str]]] = {}
    for path in sorted(PAGES.glob("*.md")):
        for block in BLOCK.finditer(path.read_text(encoding="utf-8")):
            if block[1] in found:
                raise SystemExit(f"error: 2 places for the table '{block[1]}' in {PAGES}, expected one")
            found[block[1]] = path, block
    return found


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def name_once(rows: Sequence[Sequence[str]]) -> list[list[str]]:
    """Return rows with an empty first cell if it is that of the row above."""
    names = [row[0] for row in rows]
    return [
        ["" if name == above else name, *row[1:]] for name, above, row in zip(names, ["", *names], rows, strict=False)
    ]


def describe_measurement() -> str:
    """Return the line that precedes measured tables: today's date, the commit, and the command that runs."""
    commit, changes = _git("rev-parse", "--short=7", "HEAD"), _git("status", "--porcelain", "--", *CODE)
    state = f"{commit}` with changes" if changes else f"{commit}`"
    return f"*Measured {date.today().isoformat()} at commit `{state}: `{running_command()}`.*"


def running_command() -> str:
    """Return the command that runs, without `--write`."""
    spec = sys.modules["__main__"].__spec__
    program = f"-m {spec.name.removesuffix('.__main__')}" if spec else Path(sys.argv[0]).resolve().relative_to(ROOT)
    return f"python {program} {shlex.join(option for option in sys.argv[1:] if option != '--write')}".strip()


def publish(tables: dict[str, str], *, write: bool) -> None:
    """Print tables, each below the line on its measurement, or put them between their markers in the pages."""
    study = next((each for each in read_studies() if each.command == running_command()), None)
    for name, text in tables.items():
        if not write:
            print(f"{name}\n\n{describe_measurement()}\n\n{text}", flush=True)
        elif study is None or name not in study.tables:
            raise SystemExit(f"error: {LIST.name} has no table '{name}' by `{running_command()}`; run without --write")
        else:
            _replace(name, f"; code {study.digest()}", f"{describe_measurement()}\n\n{text}")


def _replace(name: str, code: str, text: str) -> None:
    if name not in (blocks := read_blocks()):
        raise SystemExit(f"error: 0 places for the table '{name}' in {PAGES}, expected one: add its markers")
    path, block = blocks[name]
    new = f"<!-- results: {name}{code} -->\n\n{text}\n\n<!-- end -->"
    path.write_text(path.read_text(encoding="utf-8").replace(block[0], new), encoding="utf-8")
    print(f"wrote the table '{name}' to {path.name}", flush=True)


def list_stale() -> None:
    """Print the tables whose code has changed since they were measured."""
    blocks, studies = read_blocks(), read_studies()
    old = [(study, names) for study in studies if (names := study.stale(blocks))]
    count, total = sum(len(names) for _, names in old), sum(len(study.tables) for study in studies)
    print(f"results: {total - count} of {total} tables are of today's code")
    if old:
        print(f"not these; make results STALE=1 measures them again (about {sum(s.minutes for s, _ in old):.0f} min):")
    for study, names in old:
        print(f"  {blocks[names[0]][0].name}: {'; '.join(names)} ({study.minutes:g} min)")


def write_index() -> None:
    """Write the number of tables, and of those of today's code, into the index."""
    blocks, studies = read_blocks(), read_studies()
    total, stale = sum(len(study.tables) for study in studies), sum(len(study.stale(blocks)) for study in studies)
    text = table(["tables", "of the code of this commit"], [[str(total), str(total - stale)]])
    _replace("pages", "", f"{describe_measurement()}\n\n{text}")


def main(*, run: bool = False, stale: bool = False, write: bool = False) -> int:
    """List old tables, or with `--write` count them in the index.

    With `--run`, measure those of other commits, or with `--stale` those whose code has changed. The exit status is 1
    if a table was not written.
    """
    if not run:
        list_stale()
        if write:
            write_index()
        return 0
    commit = "" if stale else _git("rev-parse", "--short=7", "HEAD")
    left, missed = [study for study in read_studies() if study.stale(read_blocks(), commit)], []
    for number, study in enumerate(left):
        rest = sum(each.minutes for each in left[number:])
        print(f"[{number + 1} of {len(left)}, {rest:.0f} min left] {study.command} ({study.minutes:g} min)", flush=True)
        began = time.monotonic()
        study.run()
        missed += study.stale(read_blocks(), commit)
        print(f"{(time.monotonic() - began) / 60:.1f} min", flush=True)
    write_index()
    print(f"not written: {'; '.join(missed)}" if missed else "all of these tables are written")
    return int(bool(missed))


def _git(*arguments: str) -> str:
    done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"error: no commit to name: {done.stderr.strip()}; run the study in a clone of the repository")
    return done.stdout.strip()


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
