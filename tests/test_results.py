"""Pages of results: every table is written by one command, and other pages quote figures as they were measured."""

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
"""The index and the limits quote figures of these."""
QUOTING = [page for page in PAGES if page not in RESULTS]
MEASURED = re.compile(
    r"^\*(?:Measured (?P<day>\d{4}-\d\d-\d\d) at commit `(?P<run>[0-9a-f]{7,40})`(?: with changes)?"
    r"|Recorded (?P<last>\d{4}-\d\d-\d\d) in commit `(?P<page>[0-9a-f]{7,40})`)"
    r": (?P<commands>.+)\.\*$",
    re.MULTILINE,
)
FIGURE = re.compile(r"(?<![\w.])(\d[\d,]*(?:\.\d+)?) ?(mm|µm|px|%|deg|°|ms|s|K|times|frames/s)(?!\w)")
NUMBER = re.compile(r"(?<![\w.])(\d[\d,]*(?:\.\d+)?)( µm)?")


@pytest.mark.parametrize("page", RESULTS, ids=name_of)
def test_all_tables_are_marked_and_begin_with_their_measurement(page):
    text = page.read_text(encoding="utf-8")
    blocks = list(result_tables.BLOCK.finditer(text))
    assert blocks and text.count("<!-- ") == 2 * len(blocks)
    assert not re.search(r"^(?:\||\*Measured|\*Recorded)", result_tables.BLOCK.sub("", text), re.MULTILINE)
    for block in blocks:
        line = MEASURED.match(block[3])
        assert line, f"{name_of(page)}: no date, commit and command of '{block[1]}'"
        assert re.fullmatch(r"\n\n(?:\|.*\|\n?)+", block[3][line.end() :])
        commands = re.findall(r"`([^`]+)`", line["commands"])
        assert line["commands"] == ", ".join(f"`{command}`" for command in commands) and commands
        assert all(command.split()[0] in PROGRAMS for command in commands)


def test_each_table_has_one_study_and_each_study_its_code():
    studies = result_tables.read_studies()
    names = sorted(name for study in studies for name in study.tables)
    assert names == sorted(set(result_tables.read_blocks()) - {"pages"})
    assert len({study.command for study in studies}) == len(studies) > 40
    assert len({study.digest() for study in studies}) > 20  # A folder that does not exist ends the program.


def test_the_results_are_short():
    """Pages of tables with a few sentences: 7,800 words beside the bars of the tables are the most."""
    words = [word for page in PAGES if page.parent == FOLDER for word in page.read_text(encoding="utf-8").split()]
    assert sum(word not in ("|", "---") for word in words) <= 7_800


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


STUDY = """
[code]
all = ["code"]
[[study]]
command = "python study.py"
minutes = 2
tables = ["a table"]
code = ["all"]
[[study]]
command = "python other.py runs/results/kept"
minutes = 1
tables = ["another"]
code = ["code/one.py"]
"""
CODE = '"""Module."""\n\n\ndef one():\n    """Return 1."""\n    # Reason.\n    return 1\n'


@pytest.fixture
def project(tmp_path, monkeypatch):
    """Return a project with two studies, a page with their tables, and an index."""
    (tmp_path / "code").mkdir()
    (tmp_path / "code" / "one.py").write_text(CODE)
    for name, text in {"study.py": "", "other.py": "", "results.toml": STUDY}.items():
        (tmp_path / name).write_text(text)
    marks = "".join(f"<!-- results: {name} -->\n\nolder\n\n<!-- end -->\n\n" for name in ("a table", "another"))
    (tmp_path / "page.md").write_text(f"# Page\n\n{marks}after\n")
    (tmp_path / "index.md").write_text("# Index\n\n<!-- results: pages -->\n\n-\n\n<!-- end -->\n")
    for name, value in {"ROOT": tmp_path, "PAGES": tmp_path, "LIST": tmp_path / "results.toml"}.items():
        monkeypatch.setattr(result_tables, name, value)
    # The commit is this one, so that the test also runs without a repository.
    monkeypatch.setattr(result_tables, "_git", lambda *words: "0123abc" if words[0] == "rev-parse" else " M uwlts/x.py")
    monkeypatch.setattr(sys.modules["__main__"], "__spec__", None)
    result_tables._digest.cache_clear()
    yield tmp_path
    result_tables._digest.cache_clear()


def test_a_study_writes_its_table_with_date_commit_command_and_code(project, monkeypatch):
    monkeypatch.setattr(sys, "argv", [str(project / "study.py"), "--write"])
    table = result_tables.table(["mm"], [["0.074"]])
    result_tables.publish({"a table": table}, write=True)
    study = result_tables.read_studies()[1]
    line = f"*Measured {date.today().isoformat()} at commit `0123abc` with changes: `python study.py`.*"
    block = f"<!-- results: a table; code {study.digest()} -->\n\n{line}\n\n| mm |\n| --- |\n| 0.074 |\n\n<!-- end -->"
    assert (project / "page.md").read_text().startswith(f"# Page\n\n{block}\n\n<!-- results: another -->")
    assert MEASURED.search(block)
    with pytest.raises(SystemExit, match="has no table 'another' by `python study.py`"):
        result_tables.publish({"another": table}, write=True)
    monkeypatch.setattr(sys, "argv", [str(project / "study.py"), "--first", "3", "--write"])
    with pytest.raises(SystemExit, match="run without --write"):
        result_tables.publish({"a table": table}, write=True)


def test_only_changed_code_makes_a_table_old(project, monkeypatch, capsys):
    path, before = project / "code" / "one.py", [study.digest() for study in result_tables.read_studies()]

    def digests(text: str) -> list[str]:
        path.write_text(text)
        result_tables._digest.cache_clear()
        return [study.digest() for study in result_tables.read_studies()]

    assert digests(CODE.replace("Return 1", "Return one").replace("# Reason", "# Another reason")) == before
    assert all(new != old for new, old in zip(digests(CODE.replace("return 1", "return 2")), before, strict=True))
    (compiled := path.parent / "__pycache__").mkdir()
    (compiled / "one.kernel-1.py311.1.nbc").write_bytes(b"compiled by Numba")
    assert digests(CODE) == before
    (project / "study.py").write_text("import numpy\n")
    assert digests(CODE)[0] == before[0] and digests(CODE)[1] != before[1]


def test_studies_run_in_order_of_cost_and_continue(project, monkeypatch, capsys):
    ran, broken = [], []

    def run(command, **how):
        ran.append(command[1])
        if command[1] not in broken:
            monkeypatch.setattr(sys, "argv", [str(project / command[1]), *command[2:]])
            name = "a table" if command[1] == "study.py" else "another"
            result_tables.publish({name: result_tables.table(["mm"], [["1"]])}, write=True)

    monkeypatch.setattr(result_tables.subprocess, "run", run)
    broken.append("study.py")
    assert result_tables.main(run=True, stale=True) == 1
    assert ran == ["other.py", "study.py"] and "not written: a table" in capsys.readouterr().out
    (project / "runs/results/kept/rendered").touch()
    broken.clear()
    assert result_tables.main(run=True, stale=True) == 0 and ran[2:] == ["study.py"]
    assert "[1 of 1, 2 min left] python study.py (2 min)" in capsys.readouterr().out
    assert "| 2 | 2 |" in (project / "index.md").read_text()
    # By other code, only the study of the file is old; what it kept is removed.
    (project / "code" / "two.py").touch()
    (project / "code" / "one.py").write_text("one = 2\n")
    result_tables._digest.cache_clear()
    result_tables.main()
    assert "0 of 2 tables are of today's code" in capsys.readouterr().out
    assert result_tables.main(run=True, stale=True) == 0 and ran[3:] == ["other.py", "study.py"]
    assert not (project / "runs/results/kept/rendered").exists()
    # All: those of this commit are not measured again.
    assert result_tables.main(run=True) == 0 and len(ran) == 5
    monkeypatch.setattr(result_tables, "_git", lambda *words: "fedcba9" if words[0] == "rev-parse" else "")
    assert result_tables.main(run=True) == 0 and len(ran) == 7
