"""Refusals of the command that compares models, before the work, in one line and without a traceback."""

from pathlib import Path

import pytest

from tests.system.in_process import uwlts


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((), "no captures of a target to compare models with: give --air or --water"),
        (("--water", "missing.h5"), "no capture at missing.h5"),
        (("--water", "missing.h5", "--workers", 0), "workers is 0; it must be at least 1"),
        (("--water", "missing.h5", "--index", 0.5), "the refractive index is 0.5"),
        (("--water", "missing.h5", "--out", "models.json"), "give a name like models.html"),
        (("--water", "missing.h5", "--out", "nowhere/models.html"), "the folder nowhere does not exist"),
        (("--water", "missing.h5", "--out", "there.html"), "there.json exists already"),
    ],
)
def test_mistakes_are_explained(arguments, said, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    Path("there.json").write_text("{}", encoding="utf-8")
    done = uwlts("models", *arguments)
    assert done.returncode == 2
    assert said in done.stderr
    assert done.stderr.count("\n") == 1
    assert done.stdout == ""
    assert [path.name for path in tmp_path.iterdir()] == ["there.json"]
