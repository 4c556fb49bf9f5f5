"""Whole sweeps by the command: stopped and continued, on a Dask cluster that loses a worker, and their end.

Only formulas are used here; the rendering of designs is tested with the verification.
"""

import json
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from tests.system.in_process import run_program, shared_workers
from tests.waiting import within
from twin import cli
from twin.design.study import load_study
from twin.design.sweep import evaluate_study, list_parts, read_parts
from uwlts.model.library import load_sensor
from uwlts.runtime.workers import Workers

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
SWEEP = [sys.executable, "-m", "twin", "sweep"]
STUDY = """
title = "Small"
follow = ["focus", "waist", "volume"]
[variables."laser.baseline_mm"]
least = 60.0
most = 400.0
[variables."laser.triangulation_angle_deg"]
least = 15.0
most = 60.0
[sampling]
kind = "sobol"
designs = 8000
batch = 200
[[objectives]]
figure = "sigma_z_rms_mm"
[[objectives]]
figure = "line_mm"
goal = "maximise"
[constraints.line_mm]
least = 150.0
"""


@pytest.fixture
def study(tmp_path: Path) -> Path:
    path = tmp_path / "study.toml"
    path.write_text(STUDY, encoding="utf-8")
    return path


@pytest.fixture(scope="module", autouse=True)
def workers() -> Iterator[Workers]:
    """Working processes of all sweeps in this process; those of the sweeps that are stopped are their own."""
    with shared_workers() as pool:
        yield pool


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory, workers: Workers) -> dict[str, np.ndarray]:
    """All designs of the study, evaluated in one run."""
    folder = tmp_path_factory.mktemp("expected")
    (folder / "study.toml").write_text(STUDY, encoding="utf-8")
    evaluate_study(load_study(folder / "study.toml"), folder / "out", workers)
    return read_parts(folder / "out" / "screen")


def run(study: Path, out: Path, *more: str) -> subprocess.CompletedProcess[str]:
    return run_program(cli.app, "twin", "sweep", study, "--out", out, "--verify", "0", *more)


def begun(study: Path, out: Path, *more: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [*SWEEP, str(study), "--out", str(out), "--verify", "0", *more],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def until(condition: Callable[[], bool], *, seconds: float = 120.0) -> None:
    assert within(seconds, condition), "it took too long"


def contents(out: Path) -> dict[str, int]:
    """Parts and when they were written."""
    return {path.name: path.stat().st_mtime_ns for path in list_parts(out / "screen")}


def same(out: Path, expected: dict[str, np.ndarray]) -> None:
    found = read_parts(out / "screen")
    assert found["design"].tolist() == list(range(8000))
    np.testing.assert_array_equal(found["sigma_z_rms_mm"], expected["sigma_z_rms_mm"])
    assert found["failure"].tolist() == expected["failure"].tolist()


@pytest.mark.parametrize("sent", [signal.SIGKILL, signal.SIGINT])
def test_a_stopped_sweep_goes_on_without_repeating_or_losing(study, tmp_path, expected, sent):
    out = tmp_path / "out"
    first = begun(study, out)
    until(lambda: len(list_parts(out / "screen")) >= 5)
    first.send_signal(sent)
    _, said = first.communicate(timeout=60)
    kept = contents(out)
    assert 5 <= len(kept) < 40
    if sent == signal.SIGINT:
        assert first.returncode == 130 and "Traceback" not in said
    done = run(study, out)
    assert done.returncode == 0, done.stderr
    after = contents(out)
    assert {name: after[name] for name in kept} == kept
    same(out, expected)
    assert not [path for path in (out / "screen").iterdir() if path.name.startswith(".") and path not in kept] or (
        sent == signal.SIGKILL
    )


def test_a_finished_sweep_has_page_table_summary_and_a_sensor_that_works(study, tmp_path, expected):
    out = tmp_path / "out"
    done = run(study, out)
    assert done.returncode == 0, done.stderr
    same(out, expected)
    summary = json.loads((out / "summary.json").read_text())
    works = expected["failure"] == ""
    assert (summary["designs"], summary["work"]) == (8000, int(works.sum()))
    meets = expected["violation"] == 0
    assert summary["meet_all_constraints"] == int(meets.sum()) > 100
    best = next(one for one in summary["marked"] if one["label"].startswith("best"))
    assert best["sigma_z_rms_mm"] == expected["sigma_z_rms_mm"][meets].min()
    winner = summary["marked"][-1]
    assert winner["sigma_z_rms_mm"] <= best["sigma_z_rms_mm"] and winner["line_mm"] >= 150.0
    sensor = load_sensor(out / "winner.toml")
    assert sensor.laser.baseline_mm == pytest.approx(winner["laser.baseline_mm"])
    assert len((out / "designs.csv").read_text().splitlines()) == 8001
    assert "<html" in (out / "report.html").read_text(encoding="utf-8")
    # When run again, there is nothing left to evaluate.
    before = contents(out)
    assert run(study, out).returncode == 0
    assert contents(out) == before
    words = ("simulate", _scene(tmp_path), "--sensor", out / "winner.toml", "--out", tmp_path / "plane.h5")
    simulated = run_program(cli.app, "twin", *words, "--spp", "1")
    assert simulated.returncode == 0, simulated.stderr
    assert (tmp_path / "plane.h5").is_file()


def _scene(folder: Path) -> Path:
    path = folder / "board.toml"
    path.write_text('title = "Board"\n[[objects]]\nkind = "plate"\nwidth_mm = 50.0\nheight_mm = 300.0\n')
    return path


def test_a_study_is_not_mixed_with_another(study, tmp_path):
    out = tmp_path / "out"
    assert run(study, out, "--designs", "300").returncode == 0
    study.write_text(STUDY.replace("least = 60.0", "least = 70.0"), encoding="utf-8")
    refused = run(study, out)
    assert refused.returncode == 2 and "another variables" in refused.stderr and "Traceback" not in refused.stderr
    again = run(study, out, "--overwrite", "--designs", "300")
    assert again.returncode == 0, again.stderr
    assert read_parts(out / "screen")["laser.baseline_mm"].min() >= 70.0


def test_more_designs_may_be_asked_for(study, tmp_path, expected):
    out = tmp_path / "out"
    for count in (400, 900):
        done = run(study, out, "--designs", str(count))
        assert done.returncode == 0, done.stderr
        found = read_parts(out / "screen")
        assert found["design"].tolist() == list(range(count))
        # A batch of few designs is judged without compiled formulas, which round otherwise.
        np.testing.assert_allclose(found["sigma_z_rms_mm"], expected["sigma_z_rms_mm"][:count], rtol=1e-9)


def test_an_optimiser_beats_chance_and_goes_on_where_it_was(study, tmp_path):
    study.write_text(STUDY.replace('"sobol"', '"optimise"').replace("batch = 200", "batch = 64"), encoding="utf-8")
    out = tmp_path / "out"
    for count in (256, 512):
        done = run(study, out, "--designs", str(count))
        assert done.returncode == 0, done.stderr
        assert len(read_parts(out / "screen")["design"]) == count
    columns = read_parts(out / "screen")
    meets = columns["violation"] == 0
    # A fraction of 0.39 of all designs meets the constraint, 0.035 more or less of 200. The optimiser searches there;
    # its proposals depend on the designs evaluated before them, so that 0.53 to 0.69 were seen.
    assert meets[-200:].mean() > 0.45


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("least = 60.0\nmost = 400.0", "least = 1.0\nmost = 2.0"), "none of 8000 designs can work"),
        (("least = 60.0\nmost = 400.0", "least = 1.0\nmost = 2.0\nunit = 1"), "unknown key"),
    ],
)
def test_studies_without_an_answer_say_so(study, tmp_path, change, says):
    study.write_text(STUDY.replace(*change), encoding="utf-8")
    done = run(study, tmp_path / "out")
    assert done.returncode == 2
    assert says in done.stderr and "Traceback" not in done.stderr


@contextmanager
def cluster(folder: Path, workers: int) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """A Dask scheduler and workers, processes of their own on loopback: its address, and the workers."""
    found, processes = folder / "scheduler.json", []

    def start(program: str, *words: str) -> None:
        line = [sys.executable, "-m", f"distributed.cli.{program}", "--host", "127.0.0.1", "--no-dashboard", *words]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "cwd": folder}
        processes.append(subprocess.Popen([*line, "--scheduler-file", str(found)], **quiet))

    try:
        start("dask_scheduler", "--port", "0")
        # The file is there before its text is.
        until(lambda: found.is_file() and found.read_text().endswith("}"))
        for _ in range(workers):
            start("dask_worker", "--nthreads", "1", "--no-nanny")
        yield json.loads(found.read_text())["address"], processes[1:]
    finally:
        for process in reversed(processes):
            process.kill()
            process.wait()


def test_a_cluster_that_loses_a_worker_loses_nothing(study, tmp_path, expected):
    from distributed import Client

    out = tmp_path / "out"
    with cluster(tmp_path, 2) as (address, workers):
        with Client(address, timeout=60, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=60)
        sweeping = begun(study, out, "--scheduler", address)
        until(lambda: len(list_parts(out / "screen")) >= 5)
        workers[0].kill()
        _, said = sweeping.communicate(timeout=200)
    assert sweeping.returncode == 0, said
    same(out, expected)
