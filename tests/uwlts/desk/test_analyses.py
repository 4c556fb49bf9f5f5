"""Analyses of files in a worker process: results whole or not at all, errors as text, fields from the functions."""

import inspect
import multiprocessing
from pathlib import Path

import numpy as np
import pytest

from tests.waiting import within
from uwlts.desk.analyses import ANALYSES, Analyses, list_fields, name_results
from uwlts.desk.shown_state import Board
from uwlts.errors import DescriptionError, OutputError
from uwlts.storage.cloud import PointCloud

LONG_S = 120.0
HEIGHT_MM, NOISE_MM = 12.5, 0.02


def step_cloud(height_mm: float = HEIGHT_MM, seed: int = 0) -> PointCloud:
    """Two faces of 40 x 60 mm, one ``height_mm`` nearer, in 40 images of 60 lines, with noise."""
    frame, line = (each.ravel() for each in np.mgrid[0:40, 0:60])
    depth = 400.0 - height_mm * (line >= 30) + np.random.default_rng(seed).normal(0, NOISE_MM, frame.size)
    points = np.column_stack([frame.astype(float), line.astype(float), depth])
    return PointCloud(points, np.full(frame.size, 100.0), frame, line)


def weld_cloud() -> PointCloud:
    """A bead of 2 mm height and 12 mm width along a plate of 30 x 80 mm, in 30 images of 400 lines, with noise."""
    frame, line = (each.ravel() for each in np.mgrid[0:30, 0:400])
    across = 0.2 * line - 40.0
    bead = 2.0 * np.square(np.maximum(1 - np.square(across / 6), 0))
    depth = 400.0 - bead + np.random.default_rng(0).normal(0, NOISE_MM, frame.size)
    return PointCloud(np.column_stack([frame.astype(float), across, depth]), np.full(frame.size, 100.0), frame, line)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    step_cloud().save(tmp_path / "plate.ply")
    weld_cloud().save(tmp_path / "weld.ply")
    return tmp_path


@pytest.fixture
def analyses(folder: Path):
    shown: list[str] = []
    made = Analyses(folder, Board("test"), lambda path: shown.append(path.name))
    made.shown = shown
    yield made
    made.close()
    assert multiprocessing.active_children() == []


def carried_out(analyses: Analyses, kind: str, given: dict[str, object]):
    analyses.start(kind, given, name="", overwrite=False)
    assert within(LONG_S, lambda: not analyses.state.running)
    return analyses.state


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_fields_are_parameters_of_the_public_functions():
    seen = 0
    for kind, analysis in ANALYSES.items():
        for package, function, parameters in analysis.taken:
            known = inspect.signature(getattr(package, function)).parameters
            assert set(parameters) <= set(known)
            seen += len(parameters)
        fields = {each.name: each for each in list_fields(kind)}
        assert all(each.help and each.label for each in fields.values())
        assert next(each for each in fields.values() if each.required).file_kind in ("cloud", "capture")
    assert seen > 25
    pipe = {each.name: each for each in list_fields("inspect pipe")}
    assert pipe["wall_mm"].label == "wall, mm" and not pipe["wall_mm"].required
    assert pipe["pdf"].switch and pipe["order"].file_kind == "description"


def test_nothing_is_replaced_without_being_asked(analyses, folder):
    """The page itself, with findings of a weld and an export, is tested in tests/system/test_desk_analyses.py."""
    (folder / "mine.html").write_text("mine", encoding="utf-8")
    with pytest.raises(OutputError, match=r"mine.html exists: .* tick 'replace existing'"):
        analyses.start("inspect weld", {"cloud": "weld.ply"}, name="mine", overwrite=False)
    assert (folder / "mine.html").read_text(encoding="utf-8") == "mine"
    with pytest.raises(OutputError, match="is one of the files to read"):
        analyses.start("export", {"file": "plate.ply", "format": ".ply"}, name="plate", overwrite=True)


def test_a_cancelled_analysis_leaves_nothing(analyses, folder):
    before = names(folder)
    analyses.start("inspect weld", {"cloud": "weld.ply"}, name="", overwrite=False)
    with pytest.raises(DescriptionError, match="is running: wait until it ends, or cancel it"):
        analyses.start("inspect pipe", {"cloud": "plate.ply"}, name="", overwrite=False)
    analyses.cancel()
    assert within(LONG_S, lambda: not analyses.state.running)
    assert analyses.state.error == "cancelled; nothing was written"
    assert names(folder) == before


def test_errors_are_said_in_words_and_leave_nothing(analyses, folder):
    before = names(folder)
    state = carried_out(analyses, "inspect pipe", {"cloud": "plate.ply", "wall_mm": -2.0})
    assert state.error == "wall_mm is -2; expected a positive thickness in mm"
    assert names(folder) == before and analyses.shown == []
    for given, words in (({}, "choose the cloud first"), ({"cloud": "../plate.ply"}, "is not a file of the folder")):
        with pytest.raises(DescriptionError, match=words):
            analyses.start("inspect weld", given, name="", overwrite=False)
    with pytest.raises(DescriptionError, match="is not a name for a file"):
        analyses.start("inspect weld", {"cloud": "weld.ply"}, name="../away", overwrite=False)


@pytest.mark.slow
def test_clouds_are_compared(analyses, folder):
    step_cloud(HEIGHT_MM + 1.0, seed=1).save(folder / "later.ply")
    before = names(folder)
    state = carried_out(analyses, "compare", {"cloud": "later.ply", "reference": "plate.ply"})
    assert state.error == "" and set(state.files) == names(folder) - before
    assert len(state.files) > 1 and analyses.shown and set(analyses.shown) <= set(state.files)
    # The upper face is 1 mm nearer: one region of 40 x 30 mm, whose middle is known.
    largest = max(state.outcome.findings, key=lambda each: float(each.values[2].split()[1]))
    assert np.allclose(largest.place_mm[:2], [19.5, 44.5], atol=3.0)
    assert float(largest.values[1].split()[1]) == pytest.approx(1.0, abs=0.05)


def test_results_are_named_after_the_first_file():
    assert name_results("inspect pipe", {"cloud": "wall.ply"}) == "wall-pipe"
    assert name_results("export", {"file": "wall.laz"}) == name_results("export", {"file": "wall.cloud.h5"})
    assert name_results("export", {"file": "wall.full.ply"}) == "wall-export"
    assert name_results("register", {"clouds": ["a.ply", "b.ply"]}) == "a-registered"
    assert name_results("register", {"clouds": []}) == name_results("compare", {"cloud": None}) == ""
