"""Campaigns recorded by several processes: continued after a stop, never mixed, and without leftovers.

The campaign is a small one of the tests' own, with a sensor of few pixels.
"""

import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from twin import cli
from twin.recording.campaigns import RecordingOptions, record as record_one, record_campaigns
from twin.recording.record_scene import record_scene
from twin.rendering_options import Options
from twin.scene.campaign import list_takes, load_campaign
from uwlts.errors import CaptureError, DescriptionError
from uwlts.storage.capture import Capture, part_path
from uwlts.storage.truth import read_truth, truth_path

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
SENSOR = """
base = "thesis"
name = "small"
[camera]
width_px = 80
height_px = 64
pixel_size_um = 21.2
"""
BUILT = 'base = "sensor"\nname = "built"\n[camera]\nfocal_length_mm = 12.9\n'
BOARD = """
title = "Board"
medium = "air"
[motion]
step_mm = 2.0
count = 3
[[objects]]
kind = "plate"
width_mm = 200.0
height_mm = 160.0
[placements.standoff]
[placements.turned]
rotation_deg = [0.0, 20.0, 0.0]
[placements.moon]
position_mm = [0.0, 0.0, 400000.0]
"""
HEAD = (
    'title = "Small"\nsensor = "sensor.toml"\nas_built = "built.toml"\n[imperfections]\nstage_position_std_mm = 0.5\n'
)
CAMPAIGN = (
    HEAD
    + """
[[recordings]]
scene = "board.toml"
placements = ["standoff", "turned"]

[[recordings]]
scene = "board.toml"
name = "lamp"
motion = { lights = ["lamp", "laser"], count = 2 }

[[recordings]]
scene = "board.toml"
name = "last"
"""
)
NAMES = ["board-standoff-air", "board-turned-air", "lamp", "last"]
IMAGES = 3 + 3 + 4 + 3
LONG = 400
MANY = HEAD + "".join(
    f'[[recordings]]\nscene = "board.toml"\nname = "{name}"\nmotion = {{ step_mm = 0.1, count = {LONG} }}\n'
    for name in ("first", "second", "third")
)
IMPOSSIBLE = HEAD + '[[recordings]]\nscene = "board.toml"\nplacements = ["standoff", "moon"]\n'


@pytest.fixture(scope="module")
def described(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the descriptions."""
    folder = tmp_path_factory.mktemp("described")
    texts = {
        "sensor": SENSOR,
        "built": BUILT,
        "board": BOARD,
        "small": CAMPAIGN,
        "many": MANY,
        "impossible": IMPOSSIBLE,
    }
    for name, text in texts.items():
        (folder / f"{name}.toml").write_text(text, encoding="utf-8")
    return folder


class Progress(list):
    """Notes every ``progress(done, total)``."""

    def __call__(self, done: int, total: int) -> None:
        self.append((done, total))


def record(described: Path, folder: Path, *, name: str = "small", **how) -> Progress:
    seen = Progress()
    seeds = how.pop("seeds", range(1))
    options = RecordingOptions(**({"spp": 4, "workers": 2} | how))
    record_campaigns(load_campaign(described / f"{name}.toml"), folder, seeds=seeds, options=options, progress=seen)
    return seen


@pytest.fixture(scope="module")
def rendered(described: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Progress]:
    """A folder with the whole small campaign, and the progress of its rendering."""
    folder = tmp_path_factory.mktemp("rendered") / "deep" / "runs"
    return folder, record(described, folder)


@pytest.fixture
def copied(rendered: tuple[Path, Progress], tmp_path: Path) -> Path:
    shutil.copytree(rendered[0], tmp_path / "runs")
    return tmp_path / "runs"


@pytest.fixture(autouse=True)
def no_process_is_left():
    yield
    assert multiprocessing.active_children() == []


def contents(folder: Path) -> dict[str, tuple[bytes, int]]:
    """Every file under a folder with its content and time."""
    return {
        str(path.relative_to(folder)): (path.read_bytes(), path.stat().st_mtime_ns)
        for path in folder.rglob("*")
        if path.is_file()
    }


def assert_same_images(first: Path, second: Path) -> None:
    with Capture(first) as a, Capture(second) as b:
        assert len(a) == len(b) > 0
        assert a.header == b.header
        assert np.array_equal(a.stage_mm, b.stage_mm)
        assert all(np.array_equal(image, b.image(index)) for index, image in a.frames())
    truths = [read_truth(truth_path(path))[1] for path in (first, second)]
    assert np.array_equal(truths[0].centre_px, truths[1].centre_px, equal_nan=True)


# --- recorded files


def test_a_campaign_is_recorded(rendered: tuple[Path, Progress], described: Path):
    folder, progress = rendered
    files = [f"campaign-0/{name}{end}" for name in NAMES for end in (".h5", ".truth.h5")]
    assert sorted(contents(folder)) == sorted([*files, "plan.json"])
    assert progress == [(done, IMAGES) for done in range(IMAGES + 1)]
    plan = json.loads((folder / "plan.json").read_text(encoding="utf-8"))
    assert plan["campaign"]["imperfections"]["stage_position_std_mm"] == 0.5
    assert (plan["every"], plan["spp"]) == (1, 4)
    for take in list_takes(load_campaign(described / "small.toml"), seed=0):
        path = folder / "campaign-0" / f"{take.name}.h5"
        with Capture(path) as capture:
            assert capture.finished
            assert len(capture) == (4 if take.name == "lamp" else 3)
            assert capture.header.sensor.camera == take.sensor.camera
            assert capture.header.provenance["seed"] == take.seed
            assert max(image.max() for _, image in capture.frames(laser_on=True)) > 50, "the images show something"
        truth = read_truth(truth_path(path))[0]
        assert truth.sensor == take.built
        assert truth.scene["motion"]["position_errors_mm"] == list(take.scene.motion.position_errors_mm)


def test_a_second_run_renders_nothing_anew(rendered: tuple[Path, Progress], described: Path):
    folder = rendered[0]
    before = contents(folder)
    assert record(described, folder) == [(IMAGES, IMAGES)]
    assert contents(folder) == before


def test_interrupted_takes_are_completed_and_another_seed_adds_a_campaign(
    copied: Path, rendered: tuple[Path, Progress], described: Path
):
    """A part; an old recording with a part of its successor; a recording without its truth, a truth without its own."""
    place = copied / "campaign-0"
    part, replaced, untrue, whole = (place / f"{name}.h5" for name in NAMES)

    def stop(done: int, total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    for take, path in zip(
        list_takes(load_campaign(described / "small.toml"), seed=0)[:2], (part, replaced), strict=True
    ):
        old = [file.read_bytes() for file in (path, truth_path(path))]
        path.unlink()
        truth_path(path).unlink()
        with pytest.raises(KeyboardInterrupt):
            options = Options(spp=4, seed=take.seed)
            record_scene(take.scene, take.sensor, path, as_built=take.built, options=options, progress=stop)
        with Capture(part_path(path)) as begun:
            assert len(begun) == 2
        if path == replaced:
            path.write_bytes(old[0])
            truth_path(path).write_bytes(old[1])
    truth_path(untrue).unlink()
    (copied / "campaign-1").mkdir()
    shutil.copy(truth_path(whole), copied / "campaign-1")
    before = contents(place)
    progress = record(described, copied, seeds=range(2))
    # For incomplete recordings, all images are waited for.
    assert progress == [(done, 2 * IMAGES) for done in range(3, 2 * IMAGES + 1)]
    names = contents(rendered[0]).keys()
    assert contents(copied).keys() == names | {name.replace("campaign-0", "campaign-1") for name in names}
    for name in NAMES:
        assert_same_images(place / f"{name}.h5", rendered[0] / "campaign-0" / f"{name}.h5")
    after = contents(place)
    assert {name for name in after if after[name] == before.get(name)} == {"last.h5", "last.truth.h5"}
    with Capture(whole) as one, Capture(copied / "campaign-1" / whole.name) as other:
        assert one.header.provenance["seed"] != other.header.provenance["seed"]
        assert len(one) == len(other)
        assert any((one.image(index) != other.image(index)).any() for index in range(len(one)))


def test_overwriting_renders_again(copied: Path, rendered: tuple[Path, Progress], described: Path):
    before = contents(copied)
    part = copied / "campaign-0" / "last.h5.part"
    part.write_bytes(b"of another run")
    progress = record(described, copied, overwrite=True, workers=1)
    assert progress == [(done, IMAGES) for done in range(IMAGES + 1)]
    after = contents(copied)
    assert after.keys() == before.keys()
    assert all(after[name][1] > before[name][1] for name in before if name != "plan.json")
    for name in NAMES:
        assert_same_images(copied / "campaign-0" / f"{name}.h5", rendered[0] / "campaign-0" / f"{name}.h5")


# --- campaigns that are not mixed


@pytest.mark.parametrize(
    ("how", "differing"),
    [
        ({"spp": 3}, "spp"),
        ({"every": 2}, "every"),
        ({"spp": 3, "every": 2}, "every, spp"),
        ({"name": "many"}, "campaign"),
    ],
)
def test_another_plan_is_refused_and_nothing_is_lost(copied: Path, described: Path, how: dict, differing: str):
    before = contents(copied)
    with pytest.raises(
        DescriptionError,
        match=rf"made with another {differing} \(.* in it, .* now.*\): give another folder.*`overwrite`",
    ):
        record(described, copied, **how)
    assert contents(copied) == before


@pytest.mark.parametrize("text", [None, "{", "[1]", "{}"])
def test_recordings_of_an_unknown_plan_are_refused(copied: Path, described: Path, text: str | None):
    """They may be a real sensor's."""
    (copied / "plan.json").unlink()
    if text is not None:
        (copied / "plan.json").write_text(text, encoding="utf-8")
    before = contents(copied)
    with pytest.raises(DescriptionError, match=r"holds recordings.*`overwrite`"):
        record(described, copied)
    assert contents(copied) == before


def test_overwriting_does_not_mix_plans(copied: Path, described: Path):
    """Campaigns of seeds that are not asked for would stay as they were rendered."""
    before = contents(copied)
    with pytest.raises(
        DescriptionError,
        match=r"would keep recordings made with another spp \(spp is \d+ in it, \d+ now\), such as .*campaign-0",
    ):
        record(described, copied, spp=3, seeds=range(1, 2), overwrite=True)
    assert contents(copied) == before


@pytest.mark.parametrize("how", [{"spp": 0}, {"name": "impossible", "spp": 0}])
def test_wrong_descriptions_leave_nothing(described: Path, tmp_path: Path, how: dict):
    with pytest.raises(DescriptionError):
        record(described, tmp_path / "runs", **how)
    assert list(tmp_path.iterdir()) == []


# --- the command


@pytest.fixture
def run(capfd, monkeypatch) -> Callable[..., tuple[int, str]]:
    """Run ``twin`` in this process; return exit code and output, including that of its own processes."""

    def run(*arguments: object) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["twin", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        said = "".join(capfd.readouterr())
        assert "Traceback" not in said
        return ended.value.code, said

    return run


def test_a_campaign_without_the_scans_is_not_reproduced(run, described: Path, tmp_path: Path):
    code, said = run("reproduce", described / "small.toml", "--out", tmp_path / "runs")
    assert code == 2
    assert "campaign 'Small' has none of the scans that the calibrations measure" in said
    assert not (tmp_path / "runs").exists()


def test_a_take_that_fails_is_named(run, described: Path, tmp_path: Path):
    code, said = run("record", described / "impossible.toml", "--out", tmp_path / "runs", "--spp", 2, "--workers", 1)
    assert code == 2
    assert said.startswith("error: ")
    assert "board-moon-air.h5: " in said and "choose another placement" in said
    assert len(said.splitlines()) == 1
    assert not list(tmp_path.rglob("board-moon-air*"))


@pytest.mark.parametrize("all_of_them", [True, False], ids=["terminal", "command"])
def test_an_interrupt_ends_everything_within_seconds(described: Path, tmp_path: Path, all_of_them: bool):
    """Ctrl-C on the terminal reaches all processes, a signal from elsewhere the command alone."""
    options = ["--out", tmp_path / "runs", "--spp", 1, "--workers", 2]
    command = subprocess.Popen(
        [sys.executable, "-m", "twin", "record", described / "many.toml", *map(str, options)],
        start_new_session=True,
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    parts = [tmp_path / "runs" / f"{name}.h5.part" for name in ("first", "second")]
    while command.poll() is None and not all(map(holds_frames, parts)):
        time.sleep(0.01)
    start = time.monotonic()
    if all_of_them:
        os.killpg(command.pid, signal.SIGINT)
    else:
        command.send_signal(signal.SIGINT)
    # The output ends when the last process that holds it does.
    output, errors = command.communicate(timeout=60)
    assert time.monotonic() - start < 15
    assert command.returncode == 130, errors
    assert output == ""
    assert errors.splitlines()[-1].startswith("interrupted; ")
    assert sorted(contents(tmp_path / "runs")) == ["first.h5.part", "plan.json", "second.h5.part"]
    for part in parts:
        with Capture(part) as capture:
            assert len(capture) < LONG


def holds_frames(part: Path) -> bool:
    """Return True if the recording can be read and has an image; one without is removed when it ends early."""
    try:
        with Capture(part) as capture:
            return len(capture) > 0
    except CaptureError:
        return False


def test_one_campaign_is_recorded_into_a_folder_of_its_own(
    run, described: Path, rendered: tuple[Path, Progress], tmp_path: Path
):
    """The same captures as campaign 0 of several; again nothing is rendered, and another seed or plan is refused."""
    folder, campaign = tmp_path / "one", described / "small.toml"
    assert record_one(campaign, out=folder, spp=4, workers=1) == folder
    assert sorted(path.name for path in folder.glob("*.h5")) == sorted(
        name for take in NAMES for name in (f"{take}.h5", f"{take}.truth.h5")
    )
    for name in NAMES:
        assert_same_images(folder / f"{name}.h5", rendered[0] / "campaign-0" / f"{name}.h5")
    before = contents(folder)
    record_one(campaign, out=folder, spp=4)
    assert contents(folder) == before
    with pytest.raises(DescriptionError, match="made with another seed"):
        record_one(campaign, out=folder, spp=4, seed=1)
    code, said = run("record", campaign, "--out", folder, "--spp", 3)
    assert code == 2 and said.startswith("error: ") and "made with another spp" in said
    assert contents(folder) == before


def test_a_campaign_is_not_recorded_beside_captures_of_others(described: Path, tmp_path: Path):
    foreign = tmp_path / "mine.h5"
    foreign.write_bytes(b"a capture of the user's")
    for overwrite in (False, True):
        with pytest.raises(DescriptionError, match="mine.h5|another folder"):
            record_one(described / "small.toml", out=tmp_path, overwrite=overwrite)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.h5"]
    for key, wrong in (("seed", -1), ("every", 0), ("workers", 0)):
        with pytest.raises(DescriptionError, match=f"{key} is {wrong}"):
            record_one(described / "small.toml", out=tmp_path / "new", **{key: wrong})
