"""Documentation that can be checked without building it: links, the commands that the README names, and its length."""

import re
import shlex
from pathlib import Path

import cyclopts
import pytest

from twin.cli import app as twin_app
from uwlts.cli import app as uwlts_app

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
PAGES = (
    README,
    ROOT / "CONTRIBUTING.md",
    *sorted(path for path in (ROOT / "docs").rglob("*.md") if "_build" not in path.relative_to(ROOT).parts),
)
APPS = {"twin": twin_app, "uwlts": uwlts_app}
MOST_README_LINES = 120
"""A README is read on one's way in; everything longer has a page under docs."""
FOLDERS = ("uwlts", "twin", "tests", "docs", "scenes")
WRITTEN_LATER = {"docs/_build/html", "uwlts/targets/plain_circles.py"}
"""Named by the documentation, but made by its reader: the built site, and the example of a new target."""


def _commands(page: Path) -> list[str]:
    """Lines of indented blocks that call a command, without comments."""
    text = page.read_text(encoding="utf-8")
    code = [line.strip().removeprefix("$ ") for line in text.splitlines() if line.startswith("    ")]
    return [line.split(" #")[0].strip() for line in code if line.split(" ")[0] in APPS]


def _parsed(line: str) -> None:
    program, *arguments = shlex.split(line)
    APPS[program].parse_args(arguments, exit_on_error=False, print_error=False)


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_to_files(page):
    links = re.findall(r"\]\(([^)\s#]+)", page.read_text(encoding="utf-8"))
    missing = [link for link in links if "://" not in link and not (page.parent / link).exists()]
    assert not missing, f"{page.relative_to(ROOT)} links to files that do not exist: {missing}"


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_named_files_exist(page):
    named = re.findall(rf"`((?:{'|'.join(FOLDERS)})/[\w/.-]+)`", page.read_text(encoding="utf-8"))
    missing = [name for name in named if name not in WRITTEN_LATER and not (ROOT / name).exists()]
    assert not missing, f"{page.relative_to(ROOT)} names files that do not exist: {missing}"


def test_every_page_is_in_a_table_of_contents():
    listed = set()
    for page in PAGES:
        for block in re.findall(r"```\{toctree\}\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL):
            entries = [line for line in block.splitlines() if line and not line.startswith(":")]
            listed |= {path for entry in entries for path in page.parent.glob(f"{entry}.md")}
    pages = {path for path in PAGES if path.is_relative_to(ROOT / "docs")} - {ROOT / "docs" / "index.md"}
    assert pages == listed


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_commands_and_options_exist(page):
    for line in _commands(page):
        if "..." in line:  # an example that is not complete
            continue
        try:
            _parsed(line)
        except cyclopts.CycloptsError as error:
            pytest.fail(f"{page.relative_to(ROOT)}: '{line}': {error}")


def test_the_readme_shows_commands():
    assert {line.split()[0] for line in _commands(README)} == {"twin", "uwlts"}


def test_a_wrong_option_is_noticed():
    with pytest.raises(cyclopts.CycloptsError):
        _parsed("uwlts evaluate cloud.ply --out evaluation.json --colored cloud.ply")


def test_the_readme_is_short():
    assert len(README.read_text(encoding="utf-8").splitlines()) <= MOST_README_LINES
