"""Messages and exit codes for user errors: a message on standard error, exit code 2, no traceback.

Most cases run inside this process, as the commands' own entry points; some as processes of their own.
"""

import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import pytest
import trimesh

from twin import cli as twin_cli
from uwlts import cli as uwlts_cli
from uwlts.model.library import load_sensor
from uwlts.model.sensor import Sensor
from uwlts.pages.cloud_figure import colour_limit_mm
from uwlts.report.plot import DEVIATIONS
from uwlts.storage.calibration_file import load_calibration
from uwlts.storage.capture import Capture, CaptureHeader, Frame, part_path
from uwlts.storage.capture_writer import CaptureWriter
from uwlts.storage.cloud import PointCloud
from uwlts.storage.cloud_files import CLOUD_FORMATS, read_cloud, write_cloud

ROOT = Path(__file__).resolve().parents[2]
WIDTH, HEIGHT = 160, 128
# The thesis's sensor with pixels 8 times as large: the same view in few pixels.
SENSOR = f"""
base = "thesis"
name = "small"
[camera]
width_px = {WIDTH}
height_px = {HEIGHT}
pixel_size_um = 42.4
"""
COMMANDS = {"twin": twin_cli.main, "uwlts": uwlts_cli.main}
SUBCOMMANDS = [
    "twin simulate",
    "twin reproduce",
    "twin scenes",
    "uwlts info",
    "uwlts calibrate",
    "uwlts polynomials",
    "uwlts design",
    "uwlts nominal",
    "uwlts reconstruct",
    "uwlts evaluate",
    "uwlts thesis",
]


@dataclass(frozen=True)
class Ended:
    """Result of a command."""

    code: int
    out: str
    err: str


def exit_code(program: str, *arguments: object) -> int:
    """Run a command inside this process, as its entry point is run."""
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as ended:
        patch.setattr(sys, "argv", [program, *map(str, arguments)])
        # A broad terminal, so that messages are not broken within words.
        patch.setenv("COLUMNS", "1000")
        COMMANDS[program]()
    return ended.value.code


@pytest.fixture
def command(capsys) -> Callable[..., Ended]:
    def run(program: str, *arguments: object) -> Ended:
        code = exit_code(program, *arguments)
        printed = capsys.readouterr()
        return Ended(code, printed.out, printed.err)

    return run


@pytest.fixture
def fails(command) -> Callable[..., str]:
    """Run a wrong command and return its message."""

    def run(program: str, *arguments: object, says: str) -> str:
        ended = command(program, *arguments)
        assert ended.code == 2, ended
        assert "Traceback" not in ended.err + ended.out
        assert "wrote" not in ended.out
        assert says in ended.err, ended.err
        return ended.err

    return run


def stripe_images(count: int, *, row: float = 70.0, peak: float = 150.0) -> list[np.ndarray]:
    """A straight stripe along the width, one row lower in every image."""
    rows = np.arange(HEIGHT)[:, None] - np.linspace(-1, 1, WIDTH)
    images = [10 + peak * np.exp(-0.5 * ((rows - row - number) / 1.5) ** 2) for number in range(count)]
    return [np.clip(np.rint(image), 0, 255).astype(np.uint8) for image in images]


def write_capture(path: Path, sensor: Sensor, images: list[np.ndarray], *, laser: bool = True, **changes) -> Path:
    known = {
        "name": path.stem,
        "sensor": sensor,
        "medium_name": "water",
        "medium": sensor.media["water"],
        "stage_direction": (1.0, 0.0, 0.0),
        "saturation_dn": 255,
        "artefact": {"kind": "plane"},
    }
    with CaptureWriter(path, CaptureHeader(**(known | changes)), dtype=np.uint8) as writer:
        for number, image in enumerate(images):
            writer.append(Frame(image, float(number), laser, 1.0, float(number)))
    return path


def line_cloud(count: int) -> PointCloud:
    points = np.column_stack([np.zeros(count), np.linspace(0, 10, count), np.zeros(count)])
    return PointCloud(points, np.ones(count), np.zeros(count), np.arange(count))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One file of every kind that the programs read, made by the programs themselves, and some that are broken."""
    folder = tmp_path_factory.mktemp("files")
    (folder / "sensor.toml").write_text(SENSOR, encoding="utf-8")
    (folder / "turned.toml").write_text(f'{SENSOR}stripe_along = "height"\n', encoding="utf-8")
    (folder / "scene.toml").write_text('base = "plane"\n[motion]\nstart_mm = 0.0\ncount = 2\n', encoding="utf-8")
    (folder / "artefact.toml").write_text('kind = "plane"\n', encoding="utf-8")
    (folder / "notes.txt").write_text("stage 3 mm, laser on\n", encoding="utf-8")
    (folder / "empty").write_bytes(b"")
    sensor = load_sensor(folder / "sensor.toml")
    images = stripe_images(4)
    scan = write_capture(folder / "scan.h5", sensor, images)
    write_capture(folder / "turned.h5", load_sensor(folder / "turned.toml"), images)
    write_capture(folder / "black.h5", sensor, [np.zeros_like(images[0])] * 3)
    write_capture(folder / "white.h5", sensor, [np.full_like(images[0], 255)] * 3)
    write_capture(folder / "dark.h5", sensor, images, laser=False)
    write_capture(folder / "no-frames.h5", sensor, [])
    air = {"medium_name": "air", "medium": sensor.media["air"]}
    write_capture(folder / "air.h5", sensor, images, **air)
    write_capture(folder / "air-lamp.h5", sensor, images, laser=False, **air)
    (folder / "truncated.h5").write_bytes(scan.read_bytes()[: scan.stat().st_size // 2])
    nan = folder / "nan.h5"
    shutil.copy(scan, nan)
    with h5py.File(nan, "r+") as file:
        file["stage_mm"][1] = np.nan
    few = PointCloud(np.eye(3)[:2], np.ones(2), np.zeros(2), np.arange(2), metadata={"artefact": {"kind": "plane"}})
    write_cloud(folder / "few.ply", few)
    write_cloud(folder / "plain.ply", line_cloud(40))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for line in (
            "uwlts nominal sensor.toml --medium water --out calibration.json",
            "uwlts nominal turned.toml --medium water --out turned.json",
            "uwlts nominal thesis --medium water --out full-size.json",
            "uwlts reconstruct scan.h5 --calibration calibration.json --out scan.ply",
            "uwlts evaluate scan.ply --out scan.evaluation.json",
            "twin simulate scene.toml --sensor sensor.toml --out rendered.h5 --spp 1",
        ):
            assert exit_code(*line.split()) == 0, line
    dry = load_calibration(folder / "calibration.json").model_copy(update={"window": None, "medium_kind": "air"})
    dry.save(folder / "dry.json")
    (folder / "campaigns" / "campaign-0").mkdir(parents=True)
    (folder / "campaign").mkdir()
    for name in ("scan.h5", "scan.ply", "scan.evaluation.json", "calibration.json"):
        shutil.copy(folder / name, folder / "campaign" / name)
    return folder


@pytest.fixture(autouse=True)
def files_stay_as_they_are(folder: Path):
    """No failing command changes, adds or removes anything."""
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    yield
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


# --- the command line itself


@pytest.mark.parametrize("line", SUBCOMMANDS)
def test_help_gives_an_example(command, line: str):
    program, name = line.split()
    ended = command(program, name, "--help")
    assert (ended.code, ended.err) == (0, "")
    assert f"Example: {line}" in ended.out


@pytest.mark.parametrize("program", COMMANDS)
def test_help_lists_every_subcommand(command, program: str):
    ended = command(program, "--help")
    assert (ended.code, ended.err) == (0, "")
    listed = [line for line in SUBCOMMANDS if line.startswith(program)]
    assert len(listed) >= 2
    assert all(line.split()[1] in ended.out for line in listed)
    assert command(program).out == ended.out, "without any argument the same"


@pytest.mark.parametrize("program", COMMANDS)
def test_version(command, program: str):
    ended = command(program, "--version")
    assert (ended.code, ended.err) == (0, "")
    assert ended.out.strip()


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("uwlts bogus", "bogus"),
        ("twin bogus", "bogus"),
        ("uwlts --bogus", "--bogus"),
        ("uwlts info", "the required option --path is missing"),
        ("uwlts info a b", "b"),
        ("uwlts info thesis --bogus", "--bogus"),
        ("uwlts reconstruct scan.h5 --out x.ply", "the required option --calibration is missing"),
        ("uwlts reconstruct scan.h5 --out x.ply --calibration", "--calibration requires an argument"),
        ("uwlts reconstruct scan.h5 --calibration calibration.json", "--out"),
        ("uwlts reconstruct scan.h5 --calibration calibration.json --out x.ply --index wet", "wet"),
        ("uwlts reconstruct scan.h5 --calibration calibration.json --out x.ply --index", "--index"),
        ("uwlts reconstruct scan.h5 --calibration calibration.json --out x.ply --stripe-method magic", "magic"),
        ("uwlts reconstruct scan.h5 --calibration calibration.json --out x.ply --stripe-peak second", "second"),
        ("uwlts calibrate --out x.json", "--air"),
        ("uwlts calibrate --air air.h5 --out x.json --refractions 3", "3"),
        ("uwlts calibrate --air air.h5 --out x.json --target-poses wild", "wild"),
        ("uwlts calibrate --air air.h5 --out x.json --distortion k9", "k9"),
        ("uwlts calibrate --water scan.h5 --out x.json --new-water", "--scan"),
        ("uwlts polynomials --out x.json", "--captures"),
        ("uwlts polynomials --captures air.h5", "--out"),
        ("uwlts polynomials --captures air.h5 --out x.json --degree six", "six"),
        ("uwlts design thesis", "--medium"),
        ("uwlts design --medium water", "SENSOR"),
        ("uwlts nominal thesis --out x.json", "--medium"),
        ("uwlts evaluate scan.ply", "--out"),
        ("uwlts thesis", "--calibration is missing"),
        ("twin simulate --out x.h5", "SCENE"),
        ("twin simulate spheres", "--out"),
        ("twin simulate spheres --out x.h5 --spp many", "many"),
        ("twin simulate spheres --out x.h5 --variant scalar_rgb", "scalar_rgb"),
        ("twin reproduce --campaigns several", "several"),
        ("twin reproduce --variant scalar_rgb", "scalar_rgb"),
        ("twin reproduce --resume", "--resume"),
        ("twin scenes all", "all"),
    ],
)
def test_wrong_command_line(fails, folder: Path, monkeypatch, line: str, says: str):
    monkeypatch.chdir(folder)
    message = fails(*line.split(), says="")
    assert says.lower().lstrip("-") in message.lower()


@pytest.mark.parametrize(
    "line",
    [
        "uwlts info missing.h5",
        "twin simulate --out x.h5",
        pytest.param("uwlts bogus", marks=pytest.mark.slow),
        pytest.param("twin simulate no-scene --out x.h5", marks=pytest.mark.slow),
    ],
)
def test_as_a_process_of_its_own(tmp_path: Path, line: str):
    program, *arguments = line.split()
    ended = subprocess.run(
        [sys.executable, "-m", program, *arguments], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 2
    assert ended.stdout == ""
    assert ended.stderr
    assert "Traceback" not in ended.stderr
    assert list(tmp_path.iterdir()) == []


def test_reader_that_leaves_early_is_no_error(tmp_path: Path):
    code = f"{sys.executable} -m uwlts info thesis"
    process = subprocess.Popen(code.split(), cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    assert process.stderr.read() == b""
    process.stderr.close()
    assert process.wait(timeout=60) == 0


# --- missing files and files of another kind

# Every input file of a command, with the kinds of files that it accepts.
PLACES = {
    "reconstruct, capture": ("uwlts reconstruct {} --calibration calibration.json --out x.ply", {"scan.h5"}),
    "reconstruct, calibration": ("uwlts reconstruct scan.h5 --calibration {} --out x.ply", {"calibration.json"}),
    "calibrate, air": ("uwlts calibrate --air {} --out x.json", set()),
    "calibrate, step": ("uwlts calibrate --air air.h5 --step {} --out x.json", set()),
    "polynomials, captures": ("uwlts polynomials --captures {} --out x.json", set()),
    "design, sensor": ("uwlts design {} --medium water", {"sensor.toml"}),
    "nominal, sensor": ("uwlts nominal {} --medium water --out x.json", {"sensor.toml"}),
    "evaluate, cloud": ("uwlts evaluate {} --out x.json", {"scan.ply"}),
    "evaluate, artefact": ("uwlts evaluate scan.ply --artefact {} --out x.json", {"artefact.toml"}),
    "evaluate, truth": ("uwlts evaluate scan.ply --truth {} --out x.json", set()),
    "thesis, calibration": ("uwlts thesis {} --out x.json", {"calibration.json"}),
    "thesis, step": ("uwlts thesis calibration.json --step {} --out x.json", set()),
    "reproduce, campaign": ("twin reproduce {} --campaigns 1 --out x", set()),
    "simulate, scene": ("twin simulate {} --sensor sensor.toml --out x.h5", {"scene.toml"}),
    "simulate, sensor": ("twin simulate scene.toml --sensor {} --out x.h5", {"sensor.toml"}),
    "simulate, as built": ("twin simulate scene.toml --sensor sensor.toml --as-built {} --out x.h5", {"sensor.toml"}),
}
KINDS = [
    "scan.h5",
    "rendered.truth.h5",
    "calibration.json",
    "scan.ply",
    "scan.evaluation.json",
    "sensor.toml",
    "scene.toml",
    "artefact.toml",
    "notes.txt",
    "empty",
    "truncated.h5",
    "missing.h5",
    "missing.toml",
    ".",
]


@pytest.mark.parametrize("place", PLACES)
def test_file_of_another_kind(fails, folder: Path, monkeypatch, place: str):
    line, belongs = PLACES[place]
    monkeypatch.chdir(folder)
    tried = 0
    for kind in KINDS:
        if kind not in belongs:
            fails(*line.format(kind).split(), says="error: ")
            tried += 1
    assert tried >= len(KINDS) - 1


def test_message_names_the_file(fails, folder: Path, monkeypatch):
    monkeypatch.chdir(folder)
    for capture, says in {
        "calibration.json": "calibration.json is not a capture",
        "truncated.h5": "truncated.h5 is not a capture, or is truncated",
        "rendered.truth.h5": "format is 'uwlts-truth', expected 'uwlts-capture'",
        "nan.h5": "nan.h5 holds stage positions, exposures or times that are not finite",
    }.items():
        fails("uwlts", "reconstruct", capture, "--calibration", "calibration.json", "--out", "x.ply", says=says)
    wrong = ["uwlts", "reconstruct", "scan.h5", "--out", "x.ply", "--calibration"]
    fails(*wrong, "scan.evaluation.json", says="scan.evaluation.json is JSON but not a calibration")
    fails(*wrong, "missing.json", says="at missing.json")


@pytest.mark.parametrize("suffix", [".h5", ".truth.h5", ".h5.part", ".ply", ".json", ".toml"])
def test_info_on_files_of_another_kind(fails, folder: Path, tmp_path: Path, suffix: str):
    tried = 0
    for kind in KINDS:
        source = folder / kind
        # The content of an HDF5 file decides, also in an unfinished one.
        of_this_kind = kind.endswith(suffix.removesuffix(".part"))
        right = of_this_kind and kind != "truncated.h5"
        if source.is_file() and not right:
            shutil.copy(source, tmp_path / f"renamed{suffix}")
            fails("uwlts", "info", tmp_path / f"renamed{suffix}", says="error: ")
            tried += 1
    assert tried > 6
    fails("uwlts", "info", tmp_path / f"missing{suffix}", says=f"missing{suffix}")


def test_info_on_everything_that_is_right(command, folder: Path):
    known = {
        "scan.h5": "4 frames of 160 x 128",
        "no-frames.h5": "0 frames",
        "rendered.truth.h5": "2 frames of 160 profile lines",
        "calibration.json": "calibration of the sensor 'small'",
        "scan.ply": "cloud of",
        "scan.evaluation.json": "evaluation of",
        "sensor.toml": "sensor 'small'",
    }
    for name, words in known.items():
        ended = command("uwlts", "info", folder / name)
        assert (ended.code, ended.err) == (0, ""), name
        assert words in ended.out


def test_info_on_damaged_json(fails, folder: Path, tmp_path: Path):
    fails("uwlts", "info", folder / "notes.txt", says="notes.txt has no rows")
    fails("uwlts", "info", "no-such-sensor", says="known are thesis")
    evaluation = json.loads((folder / "scan.evaluation.json").read_text(encoding="utf-8"))
    calibration = json.loads((folder / "calibration.json").read_text(encoding="utf-8"))
    del evaluation["sha256"], calibration["sha256"]
    damaged = [
        {"format": "uwlts-evaluation", "version": 1},
        evaluation | {"evaluation": {"figures_mm": {"a": "b"}}},
        evaluation | {"evaluation": [1]},
        evaluation | {"truth": {"rms_mm": None}},
        evaluation | {"version": 2},
        calibration | {"residuals": {"camera": "good"}},
        calibration | {"residuals": {"camera": {"rms_px": "good"}}},
        calibration | {"version": 2},
        {"format": "something"},
        [1, 2],
    ]
    path = tmp_path / "a.json"
    for content in damaged:
        path.write_text(json.dumps(content), encoding="utf-8")
        fails("uwlts", "info", path, says="a.json")


def test_damaged_residuals_are_refused_by_every_command(fails, folder: Path, tmp_path: Path):
    content = json.loads((folder / "calibration.json").read_text(encoding="utf-8"))
    del content["sha256"]
    path = tmp_path / "calibration.json"
    for residuals in ({"camera": "good"}, {"camera": {"rms_px": "good"}}):
        path.write_text(json.dumps(content | {"residuals": residuals}), encoding="utf-8")
        used = ("--calibration", path, "--out", tmp_path / "x.ply")
        fails("uwlts", "reconstruct", folder / "scan.h5", *used, says="residuals.camera")


def test_cloud_without_points(command, tmp_path: Path):
    empty = PointCloud(np.empty((0, 3)), np.empty(0), np.empty(0), np.empty(0), metadata={"sensor": "small"})
    write_cloud(tmp_path / "a.ply", empty)
    ended = command("uwlts", "info", tmp_path / "a.ply")
    assert (ended.code, ended.out) == (0, "cloud without points\nsensor: small\n")


# --- captures and calibrations that do not belong together, captures that show nothing


@pytest.mark.parametrize(
    ("capture", "calibration", "says"),
    [
        ("scan.h5", "full-size.json", "has images of 160 x 128 pixels, the calibration is for 1280 x 1024"),
        ("scan.h5", "turned.json", "stripe runs along the image's width, in the calibration along its height"),
        ("turned.h5", "calibration.json", "stripe runs along the image's height, in the calibration along its width"),
        ("scan.h5", "dry.json", "the calibration is for air only"),
        ("black.h5", "calibration.json", "no stripe in any of the 3 laser images of black.h5"),
        ("white.h5", "calibration.json", "no stripe in any of the 3 laser images of white.h5"),
        ("dark.h5", "calibration.json", "none of them with the laser on"),
        ("no-frames.h5", "calibration.json", "none of them with the laser on"),
    ],
)
def test_capture_that_cannot_be_reconstructed(
    fails, folder: Path, tmp_path: Path, capture: str, calibration: str, says: str
):
    out = tmp_path / "x.ply"
    fails("uwlts", "reconstruct", folder / capture, "--calibration", folder / calibration, "--out", out, says=says)
    assert not out.exists()


def test_interrupted_capture_can_be_reconstructed(command, folder: Path, tmp_path: Path):
    part = tmp_path / "scan.h5.part"
    shutil.copy(folder / "scan.h5", part)
    ended = command("uwlts", "info", part)
    assert "the recording was interrupted" in ended.out
    calibration = folder / "calibration.json"
    ended = command("uwlts", "reconstruct", part, "--calibration", calibration, "--out", tmp_path / "x.ply")
    assert (ended.code, ended.err) == (0, "")
    assert np.array_equal(read_cloud(tmp_path / "x.ply").points_mm, read_cloud(folder / "scan.ply").points_mm)


@pytest.mark.parametrize("index", ["nan", "inf", "-1.33", "0", "0.5", "7"])
def test_refractive_index_that_no_medium_has(fails, folder: Path, tmp_path: Path, index: str):
    out = ["--out", tmp_path / "x", f"--index={index}"]
    fails("uwlts", "reconstruct", folder / "scan.h5", "--calibration", folder / "calibration.json", *out, says="index")
    fails("uwlts", "calibrate", "--air", folder / "air.h5", *out, says="index")


@pytest.mark.parametrize(
    ("air", "step"),
    [
        ("air.h5", None),
        ("air-lamp.h5", None),
        ("black.h5", None),
        ("no-frames.h5", None),
        ("air.h5", "scan.h5"),
        ("scan.h5", "air.h5"),
    ],
)
def test_calibration_without_target(fails, folder: Path, tmp_path: Path, air: str, step: str | None):
    steps = ["--step", folder / step] if step else []
    fails("uwlts", "calibrate", "--air", folder / air, *steps, "--out", tmp_path / "x.json", says="error: ")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("files", ["--air scan.h5 --step scan.h5", "--air air.h5 scan.h5"])
def test_targets_that_were_not_all_seen_in_one_medium(fails, folder: Path, tmp_path: Path, monkeypatch, files: str):
    monkeypatch.chdir(folder)
    fails("uwlts", "calibrate", *files.split(), "--out", tmp_path / "x.json", says="error: the target was seen in ")


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ("--captures air.h5", "target"),
        ("--captures black.h5", "target"),
        ("--captures no-frames.h5", "error: "),
        ("--captures air.h5 scan.h5", "error: "),
        ("--captures air.h5 --degree 0", "degree"),
        ("--captures air.h5 --degree -2", "degree"),
    ],
)
def test_polynomials_without_target(fails, folder: Path, tmp_path: Path, monkeypatch, options: str, says: str):
    monkeypatch.chdir(folder)
    fails("uwlts", "polynomials", *options.split(), "--out", tmp_path / "x.json", says=says)
    assert list(tmp_path.iterdir()) == []


# --- evaluation


@pytest.mark.parametrize(
    ("table", "says"),
    [
        ('kind = "teapot"\n', "teapot"),
        ('kind = "spheres"\n', "diameters_mm"),
        ('kind = "step"\nheight_mm = -1.0\n', "height_mm"),
        ('kind = "step"\nheight_mm = nan\n', "height_mm"),
        ('kind = "plane"\ncolour = "red"\n', "colour"),
        ("kind = \n", "not valid TOML"),
        ("# nothing\n", "artefact"),
    ],
)
def test_artefact_that_is_wrong(fails, folder: Path, tmp_path: Path, table: str, says: str):
    (tmp_path / "artefact.toml").write_text(table, encoding="utf-8")
    out = ["--out", tmp_path / "x.json"]
    fails("uwlts", "evaluate", folder / "scan.ply", "--artefact", tmp_path / "artefact.toml", *out, says=says)
    assert not (tmp_path / "x.json").exists()


def test_nothing_to_judge_by(fails, folder: Path, tmp_path: Path):
    out = ["--out", tmp_path / "x.json"]
    fails("uwlts", "evaluate", folder / "plain.ply", *out, says="there is no reference for the evaluation")
    fails("uwlts", "evaluate", folder / "few.ply", *out, says="error: ")
    fails("uwlts", "evaluate", folder / "plain.ply", "--artefact", folder / "artefact.toml", *out, says="error: ")


def test_truth_of_another_scan(fails, folder: Path, tmp_path: Path):
    """The cloud has four frames, the truth two."""
    arguments = ["--truth", folder / "rendered.truth.h5", "--out", tmp_path / "x.json"]
    fails("uwlts", "evaluate", folder / "scan.ply", *arguments, says="truth")


# --- scenes, sensors, placements


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ("no-scene --out x.h5", "nothing is called 'no-scene'"),
        ("plane --sensor no-sensor --out x.h5", "nothing is called 'no-sensor'"),
        ("plane --as-built no-sensor --out x.h5", "nothing is called 'no-sensor'"),
        ("plane --placement moon --out x.h5", "placement 'moon' is not one of near, standoff, far"),
        ("plane --medium milk --out x.h5", "'milk'"),
        ("plane --placement near far --out x.h5", "{placement}"),
        ("plane --placement near --placement far --out x.h5", "{placement}"),
        ("plane --sensor sensor.toml --as-built turned.toml --out x.h5", "differ in image size or stripe orientation"),
        ("plane --sensor sensor.toml --as-built thesis --out x.h5", "differ in image size or stripe orientation"),
        ("plane --sensor sensor.toml --spp 0 --out x.h5", "spp is 0"),
        ("plane --sensor sensor.toml --seed -1 --out x.h5", "seed is -1"),
        ("plane --sensor sensor.toml --out missing/x.h5", "missing does not exist"),
        ("plane --effects glare bloom=2 --out x.h5", "unknown effect 'bloom' to add; known are glare, vignetting"),
        ("plane --effects jpeg=900 --out x.h5", "jpeg is 900; it must be from 1 to 100"),
        ("plane --effects glare=much --out x.h5", "the strength of glare is 'much'; expected a number"),
    ],
)
def test_simulation_that_cannot_be(fails, folder: Path, monkeypatch, options: str, says: str):
    monkeypatch.chdir(folder)
    fails("twin", "simulate", *options.split(), says=says)


def test_unknown_medium(fails, tmp_path: Path):
    fails("uwlts", "nominal", "thesis", "--medium", "milk", "--out", tmp_path / "x.json", says="milk")
    fails("uwlts", "design", "thesis", "--medium", "milk", says="knows the media air, water, not 'milk'")


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ("no-campaign", "nothing is called 'no-campaign'; known are demo, detection, joint, prediction, quick, thesis"),
        ("no-campaign.toml", "no description at no-campaign.toml"),
        ("--campaigns 0", "campaigns is 0; it must be at least 1"),
        ("--campaigns -3", "campaigns is -3"),
        ("--first -1", "first is -1; it must be at least 0"),
        ("--every 0", "every is 0"),
        ("--workers 0", "workers is 0"),
        ("--spp 0", "spp is 0"),
        ("--out scan.h5", "cannot use the folder scan.h5"),
        ("--out scan.h5/runs", "cannot use the folder scan.h5/runs"),
    ],
)
def test_reproductions_that_cannot_be(fails, folder: Path, monkeypatch, options: str, says: str):
    monkeypatch.chdir(folder)
    fails("twin", "reproduce", *options.split(), says=says)


# --- outputs

BEGINNINGS = {
    ".ply": b"ply\nformat binary_little_endian",
    ".h5": b"\x89HDF",
    ".xyz": b"//X Y Z",
    ".laz": b"LASF",
    ".las": b"LASF",
    ".e57": b"ASTM-E57",
    ".mcap": b"\x89MCAP",
}
"""First bytes of the formats, by their specifications."""

OUTPUTS = {
    "calibrate": "uwlts calibrate --air air.h5 --out {}.json",
    "polynomials": "uwlts polynomials --captures air.h5 --out {}.json",
    "reconstruct": "uwlts reconstruct scan.h5 --calibration calibration.json --out {}.ply",
    "nominal": "uwlts nominal sensor.toml --medium water --out {}.json",
    "evaluate": "uwlts evaluate scan.ply --out {}.json",
    "simulate": "twin simulate scene.toml --sensor sensor.toml --spp 1 --out {}.h5",
}


@pytest.mark.parametrize("name", OUTPUTS)
def test_outputs_that_cannot_be_written(fails, folder: Path, tmp_path: Path, monkeypatch, name: str):
    monkeypatch.chdir(folder)
    ending = Path(OUTPUTS[name]).suffix
    existing, folder_there = tmp_path / f"existing{ending}", tmp_path / f"there{ending}"
    existing.write_bytes(b"precious")
    folder_there.mkdir()
    for place, says in (
        (tmp_path / "existing", f"existing{ending} exists already"),
        (tmp_path / "missing" / "x", "missing does not exist"),
        (tmp_path / "there", "not a regular file"),
        (existing / "x", f"existing{ending} does not exist"),
        (tmp_path / ("x" * 300), "File name too long"),
    ):
        fails(*OUTPUTS[name].format(place).split(), says=says)
    assert existing.read_bytes() == b"precious"
    assert set(tmp_path.iterdir()) == {existing, folder_there}


@pytest.mark.parametrize("ending", CLOUD_FORMATS)
def test_the_ending_of_a_cloud_decides_its_format(command, folder: Path, tmp_path: Path, ending: str):
    out, calibration = tmp_path / f"q{ending}", folder / "calibration.json"
    ended = command("uwlts", "reconstruct", folder / "scan.h5", "--calibration", calibration, "--out", out)
    assert ended.code == 0, ended.err
    assert out.read_bytes()[: len(BEGINNINGS[ending])] == BEGINNINGS[ending]


def test_a_coloured_cloud_has_the_colours_of_its_picture(command, folder: Path, tmp_path: Path):
    arguments = ["--out", tmp_path / "x.json", "--coloured", tmp_path / "c.ply"]
    assert command("uwlts", "evaluate", folder / "scan.ply", *arguments).code == 0
    seen, deviation = trimesh.load(tmp_path / "c.ply"), read_cloud(tmp_path / "c.ply").deviation_mm
    assert deviation is not None
    wanted = DEVIATIONS(np.clip(deviation / colour_limit_mm(deviation) / 2 + 0.5, 0, 1))
    # A value between two of the 256 colours may be rounded to either.
    assert np.abs(seen.colors[:, :3] - 255 * wanted[:, :3]).max() <= 4
    assert len(np.unique(seen.colors, axis=0)) > 10


def test_coloured_cloud_that_exists(fails, folder: Path, tmp_path: Path):
    existing = tmp_path / "existing.ply"
    existing.write_bytes(b"precious")
    arguments = ["--out", tmp_path / "x.json", "--coloured", existing]
    ended = fails("uwlts", "evaluate", folder / "scan.ply", *arguments, says="existing.ply exists already")
    assert existing.read_bytes() == b"precious"
    assert "Traceback" not in ended


def test_left_over_part_and_truth_are_refused(fails, folder: Path, tmp_path: Path, monkeypatch):
    monkeypatch.chdir(folder)
    line = f"simulate scene.toml --sensor sensor.toml --spp 1 --out {tmp_path}/a.h5".split()
    (tmp_path / "a.h5.part").write_bytes(b"precious")
    fails("twin", *line, says="a.h5.part is left from an interrupted run; give --resume")
    fails("twin", *line, "--resume", says="cannot resume: ")
    (tmp_path / "a.h5.part").rename(tmp_path / "a.truth.h5")
    fails("twin", *line, says="a.truth.h5 exists already")
    assert (tmp_path / "a.truth.h5").read_bytes() == b"precious"
    assert [path.name for path in tmp_path.iterdir()] == ["a.truth.h5"]


# --- Ctrl-C

FRAMES = 60


@pytest.mark.slow
def test_interrupted_simulation_is_kept_and_resumed(command, folder: Path, tmp_path: Path):
    scene = tmp_path / "scene.toml"
    scene.write_text(f'base = "plane"\n[motion]\nstart_mm = -30.0\nstep_mm = 0.2\ncount = {FRAMES}\n', encoding="utf-8")
    quick = ["--without", "multiple-scattering", "secondary-light", "haze"]
    options = ["--sensor", str(folder / "sensor.toml"), "--spp", "2", "--seed", "5", *quick, "--out"]
    path = tmp_path / "a.h5"
    process = subprocess.Popen(
        [sys.executable, "-m", "twin", "simulate", str(scene), *options, str(path)],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    part, frames = part_path(path), 0
    while frames < 3 and process.poll() is None:
        time.sleep(0.01)
        if part.exists():
            with Capture(part) as capture:
                frames = len(capture)
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    assert output == ""
    assert errors.startswith("interrupted; ")
    assert len(errors.splitlines()) == 1
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["a.h5.part", "scene.toml"]
    with Capture(part) as capture:
        done = len(capture)
    assert 3 <= done < FRAMES
    again = command("twin", "simulate", scene, *options, path, "--resume")
    assert (again.code, again.out, again.err) == (0, f"wrote {path}\n", "")
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["a.h5", "a.truth.h5", "scene.toml"]
    command("twin", "simulate", scene, *options, tmp_path / "undisturbed.h5")
    with Capture(path) as resumed, Capture(tmp_path / "undisturbed.h5") as undisturbed:
        assert len(resumed) == len(undisturbed) == FRAMES
        assert all(np.array_equal(image, undisturbed.image(index)) for index, image in resumed.frames())
        assert np.array_equal(resumed.stage_mm, undisturbed.stage_mm)
        assert any(image.max() > 50 for _, image in resumed.frames()), "the images show something"
