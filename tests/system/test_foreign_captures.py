"""Truncated, wrongly sized, black, white or rotated images and captures, and those without a stripe: messages.

One line names the cause, the exit code is 2, and nothing is written. All images are drawn here."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.system.in_process import uwlts
from tests.uwlts.calibration_views import lattice, stage_images
from tests.uwlts.drawn_stripes import SPHERES, STAGE_MM, coarse_sensor, sphere_profiles, step_image, stripe_image, write
from tests.uwlts.drawn_target import drawn_lamp, drawn_laser
from uwlts import cli
from uwlts.model.sensor import Medium
from uwlts.optics.nominal import nominal_calibration
from uwlts.storage.capture import Capture, CaptureHeader, Frame
from uwlts.storage.capture_writer import CaptureWriter
from uwlts.targets import CircleTarget

SENSOR = coarse_sensor(window_mounted=False)
WET = coarse_sensor(window_mounted=True)
PLATE = {"kind": "circles", "diameter_mm": 6.0, "marker_diameter_mm": 2.5, "columns": 17, "rows": 13, "origin": (8, 6)}
POSITIONS = np.arange(5) * 40.0
STEP = {"kind": "step", "height_mm": 23.17}
TOLD = """
medium = "water"
laser = "laser*"
[stage]
start_mm = 0.0
step_mm = 1.0
direction = [1.0, 0.0, 0.0]
[sensor]
base = "thesis"
[sensor.camera]
width_px = {width}
height_px = {height}
"""
Damage = Callable[[list[Frame]], list[Frame]]


@pytest.fixture(scope="module")
def target_frames() -> list[Frame]:
    """A lamp and a laser image at every position."""
    target = CircleTarget(**PLATE)
    _, poses, _ = stage_images(SENSOR, positions=POSITIONS, points=lattice(17, 13))
    lamps = [drawn_lamp(SENSOR, target, pose, seed=k) for k, pose in enumerate(poses)]
    lasers = [drawn_laser(SENSOR, pose, seed=k) for k, pose in enumerate(poses)]
    return [
        Frame(image, float(stage), on, 1.0, 0.0)
        for stage, *both in zip(POSITIONS, lamps, lasers, strict=True)
        for image, on in zip(both, (False, True), strict=True)
    ]


@pytest.fixture(scope="module")
def scan_images() -> list[np.ndarray]:
    """Two spheres in water."""
    return [stripe_image(pieces, np.random.default_rng(k)) for k, pieces in enumerate(sphere_profiles(20.0))]


def images(change: Callable[[np.ndarray], np.ndarray], *, laser: bool | None = None) -> Damage:
    """Changes all images, or those with the laser on or off."""
    return lambda frames: [
        replace(f, image=np.ascontiguousarray(change(f.image))) if laser in (None, f.laser_on) else f for f in frames
    ]


def black(image: np.ndarray) -> np.ndarray:
    return np.zeros_like(image)


def white(image: np.ndarray) -> np.ndarray:
    return np.full_like(image, 255)


def upside_down(image: np.ndarray) -> np.ndarray:
    return image[::-1, ::-1]


def turned(image: np.ndarray) -> np.ndarray:
    return np.rot90(image)


def turned_square(image: np.ndarray) -> np.ndarray:
    """Turn the image without a change of its size."""
    return np.rot90(image[:, 64:576])


def noise(image: np.ndarray) -> np.ndarray:
    """Noise of its own for each image: equal images have a warning of their own."""
    return np.random.default_rng(int(image.sum())).poisson(8, image.shape).astype(np.uint8)


def switched(frames: list[Frame]) -> list[Frame]:
    return [replace(f, laser_on=not f.laser_on) for f in frames]


def captured(path: Path, frames: list[Frame], **rest: object) -> Path:
    """The frames as a capture of a sensor with images of their size."""
    height, width = frames[0].image.shape
    camera = SENSOR.camera.model_copy(update={"width_px": width, "height_px": height, "principal_point_px": None})
    sensor = SENSOR if (width, height) == (640, 512) else SENSOR.model_copy(update={"camera": camera})
    header = CaptureHeader(
        name=path.stem,
        sensor=sensor,
        medium_name="air",
        medium=Medium(kind="air"),
        stage_direction=(0.0, 0.0, 1.0),
        saturation_dn=255,
        **rest,
    )
    with CaptureWriter(path, header, dtype=np.uint8) as writer:
        for frame in frames:
            writer.append(frame)
    return path


@pytest.fixture
def says(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Callable[[str, str], None]:
    """Run a command line, which must fail with a matching line on standard error and write nothing.

    Only a table of the target's images may follow.
    """

    def check(line: str, words: str) -> None:
        arguments = line.split()
        monkeypatch.setattr("sys.argv", ["uwlts", *arguments])
        capfd.readouterr()
        with pytest.raises(SystemExit) as ended:
            cli.main()
        out, err = capfd.readouterr()
        # On a slow machine, lines of progress precede the message.
        lines = [line for line in err.strip().splitlines() if not re.search(r" after \d+ s$", line)]
        table = [line for line in lines[1:] if re.match(r"image {20,}stage, mm|\S+\.h5, frame \d+ +-?\d", line)]
        assert ended.value.code == 2 and lines[0].startswith("error: ") and table == lines[1:], (out, err)
        assert re.search(words, lines[0]), lines[0]
        assert not Path(arguments[arguments.index("--out") + 1]).exists()

    return check


# --- Folders of images


def folder_of(place: Path, frames: list[np.ndarray], suffix: str = ".png", size: tuple[int, int] = (640, 512)) -> Path:
    place.mkdir()
    for number, image in enumerate(frames):
        assert cv2.imwrite(str(place / f"laser{number}{suffix}"), image)
    (place / "import.toml").write_text(TOLD.format(width=size[0], height=size[1]), encoding="utf-8")
    return place


@pytest.mark.parametrize("suffix", [".png", ".tif", ".bmp", ".jpg"])
def test_truncated_images(says, scan_images, tmp_path: Path, suffix: str):
    """However much is missing, only the message is printed, also by libraries."""
    folder = folder_of(tmp_path / "images", scan_images[:3], suffix)
    victim = folder / f"laser1{suffix}"
    whole = victim.read_bytes()
    for share in (0.0, 0.001, 0.3, 0.9, 0.999):
        victim.write_bytes(whole[: int(share * len(whole))])
        words = "laser1.* (is truncated|truncated or damaged|it is empty|is no PNG|holds no)"
        says(f"import {folder} --out {tmp_path / 'x.h5'}", words)


@pytest.mark.parametrize("suffix", [".png", ".tif", ".jpg"])
def test_images_with_a_hole(says, scan_images, tmp_path: Path, suffix: str):
    """Pixels that a decoder substitutes for missing bytes are not accepted; in BMP they cannot be detected."""
    folder = folder_of(tmp_path / "images", scan_images[:3], suffix)
    victim = folder / f"laser1{suffix}"
    content = bytearray(victim.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 300] = bytes(300)
    victim.write_bytes(content)
    says(
        f"import {folder} --out {tmp_path / 'x.h5'}",
        "laser1.*damaged .*(its decoder says: .*|a checksum does not fit .*); copy it again",
    )


# --- Captures of the target

TARGETS: dict[str, tuple[Damage, str]] = {
    "upside down": (images(upside_down), "sheet's normal is turned by .* the images are turned by 180 deg or mirrored"),
    "mirrored": (images(np.flipud), "they fit with columns and rows exchanged, as in a mirrored image"),
    "black": (images(black), r"found in no image of x.h5: too dark: .* 0 % of the full scale.* \(5 of 5 images\)"),
    "white": (images(white), "found in no image of x.h5: saturated: 100 % of the image is at the full scale"),
    "lamp off": (images(black, laser=False), "found in no image of x.h5: too dark"),
    "noise": (images(noise), "found in no image of x.h5: too dark: the image reaches [0-9]+ % of the full scale"),
    "switched": (switched, "found in no image of x.h5: .*lamp and laser images are exchanged"),
    "laser off": (images(black, laser=True), "no stripe in any of the 5 laser images of x.h5: all are black"),
    "laser white": (images(white, laser=True), "no stripe in any of the 5 laser images of x.h5: all are white"),
    "no stripe": (
        images(noise, laser=True),
        "no stripe in any of the 5 .* of x.h5: no bright line is above the background",
    ),
    "stripe across": (
        images(turned_square),
        "no stripe in any of the 5 .* 5 of 5 images show a stripe across .* rotated by 90 deg",
    ),
    "lamp only": (lambda frames: [f for f in frames if not f.laser_on], "x.h5: no image with the laser on; take one"),
    "laser only": (lambda frames: [f for f in frames if f.laser_on], "all of them were taken with the laser on"),
    "elsewhere": (
        lambda frames: [replace(f, stage_mm=f.stage_mm + 5) if f.laser_on else f for f in frames],
        "with a stripe were taken at other stage positions than the images with the target",
    ),
}


@pytest.mark.parametrize("name", TARGETS)
def test_captures_of_the_target(says, target_frames, tmp_path: Path, name: str):
    damage, words = TARGETS[name]
    path = captured(tmp_path / "x.h5", damage(target_frames), target=PLATE)
    says(f"calibrate --air {path} --out {tmp_path / 'x.json'}", words)


def test_the_target_as_it_should_be_calibrates(target_frames, tmp_path: Path):
    """The same images undamaged, as a control for the refusals."""
    path = captured(tmp_path / "x.h5", target_frames, target=PLATE)
    ended = uwlts("calibrate", "--air", path, "--out", tmp_path / "x.json")
    assert (ended.returncode, ended.stderr) == (0, "")


@pytest.mark.parametrize("name", ["black", "switched", "laser off", "stripe across"])
@pytest.mark.parametrize("line", ["polynomials --degree 3 --captures", "calibrate --joint --air"])
def test_other_calibrations_say_the_same(says, target_frames, tmp_path: Path, name: str, line: str):
    damage, words = TARGETS[name]
    path = captured(tmp_path / "x.h5", damage(target_frames), target=PLATE)
    says(f"{line} {path} --out {tmp_path / 'x.json'}", words)


def test_polynomials_of_images_upside_down(says, target_frames, tmp_path: Path):
    path = captured(tmp_path / "x.h5", images(upside_down)(target_frames), target=PLATE)
    says(f"polynomials --degree 3 --captures {path} --out {tmp_path / 'x.json'}", "not rotated by 180 deg or mirrored")


# --- Captures of steps and scans


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (black, "no stripe in any of the 2 laser images of step.h5: all are black"),
        (white, "no stripe in any of the 2 laser images of step.h5: all are white"),
        (noise, "no stripe in any of the 2 laser images of step.h5: no bright line"),
        (upside_down, "bound of the searched window distances.*not rotated or mirrored|no step image can be used"),
    ],
    ids=["black", "white", "noise", "upside down"],
)
def test_captures_of_a_step(says, target_frames, tmp_path: Path, change, words: str):
    target = captured(tmp_path / "x.h5", target_frames, target=PLATE)
    steps = [np.ascontiguousarray(change(step_image(depth))) for depth in (-40.0, 60.0)]
    step = write(tmp_path / "step.h5", steps, artefact=STEP)
    says(f"calibrate --air {target} --step {step} --out {tmp_path / 'x.json'}", words)


def test_a_step_with_exchanged_sides(says, target_frames, tmp_path: Path):
    target = captured(tmp_path / "x.h5", images(turned)(target_frames), target=PLATE)
    step = write(tmp_path / "step.h5", [step_image(20.0)], artefact=STEP)
    words = "image size is 640 x 512 px instead of 512 x 640 px; the images of one are rotated by 90 deg"
    says(f"calibrate --air {target} --step {step} --out {tmp_path / 'x.json'}", words)


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    path = tmp_path / "nominal.json"
    nominal_calibration(WET, Medium(kind="custom", index=1.3312)).save(path)
    return path


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (black, "no stripe in any of the 11 laser images of scan.h5: all are black"),
        (white, "no stripe in any of the 11 laser images of scan.h5: all are white"),
        (noise, "no stripe in any of the 11 laser images of scan.h5: no bright line"),
    ],
    ids=["black", "white", "noise"],
)
def test_scans_without_a_stripe(says, scan_images, calibration, tmp_path: Path, change, words: str):
    scan = write(tmp_path / "scan.h5", [change(image) for image in scan_images], stage_mm=STAGE_MM, artefact=SPHERES)
    says(f"reconstruct {scan} --calibration {calibration} --out {tmp_path / 'x.ply'}", words)


def test_scans_of_another_size(says, scan_images, calibration, tmp_path: Path):
    frames = [Frame(image, 0.0, True, 1.0, 0.0) for image in scan_images[:2]]
    wrong = captured(tmp_path / "scan.h5", images(turned)(frames))
    line = f"--calibration {calibration} --out {tmp_path / 'x.ply'}"
    says(
        f"reconstruct {wrong} {line}", "512 x 640 pixels, the calibration is for 640 x 512: rotate the images by 90 deg"
    )
    small = captured(tmp_path / "small.h5", images(lambda image: image[:256])(frames))
    says(f"reconstruct {small} {line}", "640 x 256 pixels, .* 640 x 512: calibrate with images of this size")


def test_a_scan_upside_down_gives_hollow_spheres(says, scan_images, calibration, tmp_path: Path):
    turned_over = [np.ascontiguousarray(upside_down(image)) for image in scan_images]
    scan = write(tmp_path / "scan.h5", turned_over, stage_mm=STAGE_MM, artefact=SPHERES)
    cloud = tmp_path / "scan.ply"
    assert uwlts("reconstruct", scan, "--calibration", calibration, "--out", cloud).returncode == 0
    says(f"evaluate {cloud} --out {tmp_path / 'x.json'}", "hollow: .* rotated by 180 deg or mirrored")


@pytest.mark.parametrize("share", [0.0, 0.001, 0.5, 0.999])
def test_truncated_captures(says, scan_images, calibration, tmp_path: Path, share: float):
    scan = write(tmp_path / "scan.h5", scan_images, stage_mm=STAGE_MM)
    whole = scan.read_bytes()
    scan.write_bytes(whole[: int(share * len(whole))])
    words = (
        "not an HDF5 file"
        if share == 0
        else f"truncated: it has {int(share * len(whole)):,} of its {len(whole):,} bytes"
    )
    says(f"reconstruct {scan} --calibration {calibration} --out {tmp_path / 'x.ply'}", words)


def test_captures_with_a_hole(says, scan_images, calibration, tmp_path: Path):
    """The checksum of an image identifies the damaged one."""
    scan = write(tmp_path / "scan.h5", scan_images, stage_mm=STAGE_MM)
    with Capture(scan) as capture:
        place = capture.file["frames"].id.get_chunk_info(4).byte_offset
    content = bytearray(scan.read_bytes())
    content[place + 2000 : place + 2100] = bytes(100)
    scan.write_bytes(content)
    words = "frame 4 of .*scan.h5 cannot be read: the file is damaged"
    says(f"reconstruct {scan} --calibration {calibration} --out {tmp_path / 'x.ply'}", words)
