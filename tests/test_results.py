"""Pages of results: every table states its measurement, and other pages quote figures as they were measured."""

import re
import subprocess
import sys
from collections.abc import Iterator
from datetime import date
from functools import cache
from pathlib import Path

import pytest

from docs.studies import result_tables
from tests.documented import PAGES, PROGRAMS, README, ROOT, name_of

FOLDER = ROOT / "docs" / "results"
RESULTS = [page for page in PAGES if page.parent == FOLDER and page.name not in ("index.md", "limits.md")]
"""The index contains no figures, and the limits quote those of other pages."""
QUOTING = [page for page in PAGES if page not in RESULTS]
MEASURED = re.compile(
    r"^\*(?:Measured (?P<day>\d{4}-\d\d-\d\d) at commit `(?P<run>[0-9a-f]{7,40})`(?: with changes)?"
    r"|Recorded (?:\d{4}-\d\d-\d\d to )?(?P<last>\d{4}-\d\d-\d\d) in commit `(?P<page>[0-9a-f]{7,40})`)"
    r": (?P<commands>.+)\.\*$",
    re.MULTILINE,
)
NO_COMMAND = "no command was kept"
FIGURE = re.compile(r"(?<![\w.])(\d[\d,]*(?:\.\d+)?) ?(mm|µm|px|%|deg|°|ms|s|K|times|frames/s)(?!\w)")
NUMBER = re.compile(r"(?<![\w.])(\d[\d,]*(?:\.\d+)?)( µm)?")


def _sections(text: str) -> list[str]:
    return re.split(r"^(?=#+ )", text, flags=re.MULTILINE)


@pytest.mark.parametrize("page", RESULTS, ids=name_of)
def test_tables_and_sections_with_figures_state_their_measurement(page):
    for section in _sections(page.read_text(encoding="utf-8")):
        first = re.search(r"^\|", section, re.MULTILINE)
        if first or (section.startswith("## ") and FIGURE.search(section)):
            line = MEASURED.search(section)
            assert line, f"{name_of(page)}: no date, commit and command under '{section.splitlines()[0]}'"
            assert first is None or line.start() < first.start(), f"{name_of(page)}: a table before its measurement"


@pytest.mark.parametrize("page", RESULTS, ids=name_of)
def test_lines_on_measurements_have_one_form_and_name_commands(page):
    text = page.read_text(encoding="utf-8")
    lines = list(MEASURED.finditer(text))
    assert len(lines) == len(re.findall(r"^\*(?:Measured|Recorded)", text, re.MULTILINE)) > 0
    for line in lines:
        commands = re.findall(r"`([^`]+)`", line["commands"])
        assert line["commands"] == (", ".join(f"`{command}`" for command in commands) or NO_COMMAND)
        assert all(command.split()[0] in PROGRAMS for command in commands)


@cache
def _commits() -> dict[str, str]:
    """Return the days of all commits by their hashes; none without the whole history."""
    shallow = subprocess.run(["git", "rev-parse", "--is-shallow-repository"], cwd=ROOT, capture_output=True, text=True)
    if shallow.returncode or shallow.stdout.strip() != "false":
        return {}
    command = ["git", "log", "--format=%H %ad", "--date=short"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return dict(line.split() for line in listed.splitlines())


@pytest.mark.parametrize("page", RESULTS, ids=name_of)
def test_named_commits_are_in_the_history(page):
    if not _commits():
        pytest.skip("the whole history is needed: git fetch --unshallow")
    for line in MEASURED.finditer(page.read_text(encoding="utf-8")):
        days = [day for commit, day in _commits().items() if commit.startswith(line["run"] or line["page"])]
        assert len(days) == 1, f"{name_of(page)}: no commit of {line[0]}"
        assert days[0] == line["last"] if line["page"] else days[0] <= line["day"], f"{name_of(page)}: {line[0]}"


@pytest.mark.parametrize("page", RESULTS, ids=name_of)
def test_a_study_writes_each_marked_table(page):
    studies = [*(ROOT / "docs" / "studies").glob("*.py"), *(ROOT / "tests" / "bench").glob("*.py")]
    sources = "\n".join(path.read_text(encoding="utf-8") for path in studies)
    text = page.read_text(encoding="utf-8")
    names = re.findall(r"<!-- results: (.+) -->\n\n(?=\*)", text)
    assert text.count("<!-- results: ") == text.count("<!-- end -->") == len(names)
    for name in names:
        # A study may put together the name of a table from a group and a key.
        parts = (name, *re.split(r"(?<=, )|(?<=by a )", name)) if name not in sources else (name,)
        assert name in sources or all(part in sources for part in parts[1:]), f"{name_of(page)}: no study of '{name}'"


def _quotes(page: Path) -> Iterator[tuple[Path, str]]:
    """Yield pages of results and the texts that quote them.

    A text is a paragraph or a row of a table with a link, and a table below a paragraph that ends with a link and a
    colon.
    """
    introduced: list[Path] = []
    for block in re.split(r"\n\s*\n", page.read_text(encoding="utf-8")):
        table = block.startswith("|")
        for text in block.splitlines() if table else [block]:
            linked = [(page.parent / link).resolve() for link in re.findall(r"\]\(([^)\s#]+\.md)", text)]
            quoted = [path for path in linked if path in RESULTS]
            for path in quoted or (introduced if table else []):
                yield path, re.sub(r"\]\([^)]*\)|`[^`]*`", "", text)
            if not table:
                introduced = quoted if re.search(r"\)\)?:$", block) else []


def _figures(text: str) -> list[str]:
    """Return the figures of a text: numbers with a unit, and the decimal numbers in cells of a table."""
    found = [match[1] for match in FIGURE.finditer(text)]
    if text.startswith("|"):
        found += [number for number, _ in NUMBER.findall("|".join(text.split("|")[2:])) if "." in number]
    return found


def _differing(text: str, results: str) -> list[str]:
    """Return the figures of a text that no number of a page of results rounds to."""
    measured = [float(number.replace(",", "")) * (1e-3 if unit else 1.0) for number, unit in NUMBER.findall(results)]
    measured += [float(number.replace(",", "")) for number, _ in NUMBER.findall(results)]
    differing = []
    for figure in _figures(text):
        half = 0.5 * 10.0 ** -len(figure.partition(".")[2])
        if not any(abs(value - float(figure.replace(",", ""))) <= half * (1 + 1e-9) for value in measured):
            differing.append(figure)
    return differing


@pytest.mark.parametrize("page", QUOTING, ids=name_of)
def test_quoted_figures_are_those_of_the_results(page):
    for path, text in _quotes(page):
        differing = _differing(text, path.read_text(encoding="utf-8"))
        assert not differing, f"{name_of(page)}: {name_of(path)} has no {', '.join(differing)}: '{text}'"


@pytest.mark.parametrize(
    ("page", "least"),
    [(README, 9), (ROOT / "docs/how-to/choose-a-calibration.md", 10), (ROOT / "docs/explanation/error-budget.md", 20)],
    ids=lambda value: name_of(value) if isinstance(value, Path) else "",
)
def test_tables_of_accuracy_are_compared(page, least):
    assert sum(len(_figures(text)) for _, text in _quotes(page)) >= least


def test_an_older_figure_is_noticed():
    results = "| mean error | 0.0737 | 24 µm |"
    assert _differing("| spacing | 0.074 | 0.024 |", results) == []
    assert _differing("| spacing | 0.073 | 0.025 |", results) == ["0.073", "0.025"]
    assert _differing("a mean error of 0.08 mm", results) == ["0.08"]


def test_a_study_writes_its_table_with_date_commit_and_command(tmp_path, monkeypatch):
    page = tmp_path / "page.md"
    page.write_text("before\n\n<!-- results: a table -->\n\nolder\n\n<!-- end -->\n\nafter\n", encoding="utf-8")
    monkeypatch.setattr(result_tables, "PAGES", tmp_path)
    # The commit is this one, so that the test also runs without a repository.
    monkeypatch.setattr(result_tables, "_git", lambda *words: "0123abc" if words[0] == "rev-parse" else " M uwlts/x.py")
    monkeypatch.setattr(sys, "argv", [str(ROOT / "docs/studies/mount_calibration.py"), "60", "--write"])
    monkeypatch.setattr(sys.modules["__main__"], "__spec__", None)
    result_tables.publish({"a table": result_tables.table(["mm"], [["0.074"]])}, write=True)
    today = date.today().isoformat()
    line = f"*Measured {today} at commit `0123abc` with changes: `python docs/studies/mount_calibration.py 60`.*"
    table = "| mm |\n| --- |\n| 0.074 |"
    block = f"<!-- results: a table -->\n\n{line}\n\n{table}\n\n<!-- end -->"
    assert page.read_text(encoding="utf-8") == f"before\n\n{block}\n\nafter\n"
    assert MEASURED.search(block)
    with pytest.raises(SystemExit, match="0 places for the table 'another'"):
        result_tables.publish({"another": table}, write=True)
