"""Blocks of the documentation's pages: command lines, Python, and other indented or fenced text."""

import re
import shlex
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
PAGES = (
    README,
    ROOT / "CONTRIBUTING.md",
    *sorted(
        path for path in (ROOT / "docs").rglob("*.md") if not {"_build", "paper"} & set(path.relative_to(ROOT).parts)
    ),
)
APPS = ("twin", "uwlts")
PROGRAMS = (*APPS, "cd", "make", "pip", ".venv/bin/pip", "pytest", "python", "python3", ".venv/bin/python")
"""First words of a command line."""
_SHELL = ("", "bash", "console", "sh", "shell")
_SITE = ("{toctree}", "{eval-rst}")
"""Fences for directives of Sphinx; `make docs` rejects errors in them."""


@dataclass(frozen=True)
class Block:
    """An indented or fenced block of a page, with the number of its first line."""

    page: Path
    line: int
    kind: Literal["commands", "python", "toml", "site", "text"]
    text: str

    def __str__(self) -> str:
        return f"{name_of(self.page)}:{self.line}"

    @property
    def commands(self) -> list[str]:
        """Return command lines without prompts and comments; lines after a prompt line are the command's output."""
        lines = self.text.splitlines()
        prompted = [line.removeprefix("$ ") for line in lines if line.startswith("$ ")]
        return [re.split(r"\s+#\s", line)[0].strip() for line in prompted or lines if line.strip()]


def name_of(page: Path) -> str:
    """Path of a page in the project, such as `docs/install.md`."""
    return str(page.relative_to(ROOT))


def blocks(page: Path) -> list[Block]:
    """All indented and fenced blocks of a page, in its order."""
    lines = page.read_text(encoding="utf-8").splitlines()
    if lines and lines[0] == "---":  # the header of a notebook
        lines = [""] * (lines.index("---", 1) + 1) + lines[lines.index("---", 1) + 1 :]
    return [Block(page, line, _kind(info, text), text) for line, info, text in _raw_blocks(lines)]


def mentioned_commands(page: Path) -> list[tuple[int, str]]:
    """Line number and text of the commands in a page's sentences; some are abridged, as `uwlts calibrate --joint`."""
    lines = enumerate(page.read_text(encoding="utf-8").splitlines(), 1)
    found = [(number, text) for number, line in lines for text in re.findall(r"`([^`]+)`", line)]
    return [(number, text) for number, text in found if text.split(" ")[0] in PROGRAMS and "..." not in text]


def words_of(command: str) -> list[str]:
    """Return the words of a command line as a shell splits them; patterns of names are not expanded."""
    return shlex.split(command)


def _raw_blocks(lines: list[str]) -> Iterator[tuple[int, str | None, str]]:
    """Yield the first line's number, the text behind the fence (None: indented) and the text of each block."""
    at = 0
    while at < len(lines):
        if fence := re.match(r"(\s*)(`{3,}|~{3,})\s*(.*)", lines[at]):
            end = next(k for k in range(at + 1, len(lines)) if lines[k].strip() == fence[2])
            yield at + 2, fence[3].strip(), "\n".join(line.removeprefix(fence[1]) for line in lines[at + 1 : end])
            at = end + 1
        elif lines[at].startswith("    ") and not (at and lines[at - 1].strip()):
            end = next((k for k in range(at, len(lines)) if lines[k] and not lines[k].startswith("    ")), len(lines))
            yield at + 1, None, "\n".join(line[4:] for line in lines[at:end]).rstrip()
            at = end
        else:
            at += 1


def _kind(info: str | None, text: str) -> Literal["commands", "python", "toml", "site", "text"]:
    language = (info or "").split(" ")[0]
    if language == "{code-cell}" or language == "python":
        return "python"
    if language in _SITE:
        return "site"
    if text.removeprefix("$ ").split(" ")[0] in PROGRAMS and language in _SHELL:
        return "commands"
    if language == "toml" or (info is None and _is_toml(text)):
        return "toml"
    return "text"


def _is_toml(text: str) -> bool:
    try:
        return bool(tomllib.loads(text))
    except tomllib.TOMLDecodeError:
        return False
