"""Captures of centre lines: storage, import from tables, arrays and images, export, measurement, and refusals."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import tomli_w

import uwlts
from tests.uwlts.storage.test_import import GIVEN, HEIGHT, WIDTH, lamp_image
from uwlts.errors import CaptureError, DescriptionError, ImageError
from uwlts.model.stripe import Coordinates
from uwlts.storage.capture import Capture, Frame
from uwlts.storage.capture_writer import CaptureWriter
from uwlts.stripe import StripeStatus, find_stripes

SCALE, OFFSET = 1 / 16, -2.0


def profiles(count: int = 4) -> np.ndarray:
    """Positions (count, WIDTH) in px on a grid of 1/16, NaN without a stripe."""
    rng = np.random.default_rng(5)
    places = np.round(16 * (20 + 5 * np.sin(np.arange(WIDTH) / 9) + rng.normal(0, 1, (count, WIDTH)))) / 16
    places[rng.random((count, WIDTH)) < 0.1] = np.nan
    return places


def raw(places: np.ndarray) -> np.ndarray:
    """The camera's numbers for positions; 0 means no stripe."""
    return np.nan_to_num(np.round((places - OFFSET) / SCALE), nan=0.0).astype(np.uint16)


def described(folder: Path, laser: str, **more) -> Path:
    table = GIVEN | {"laser": laser, "centre_lines": {"scale": SCALE, "offset": OFFSET, "invalid": 0}} | more
    folder.mkdir(exist_ok=True)
    (folder / "import.toml").write_text(tomli_w.dumps(table))
    return folder


def write(path: Path, places: np.ndarray) -> None:
    match path.suffix:
        case ".npy":
            np.save(path, raw(places).astype(">f8") if "big-endian" in path.name else raw(places))
        case ".csv":
            path.write_text("\n".join(";".join(map(str, row)) for row in raw(places).tolist()))
        case _:
            assert cv2.imwrite(str(path), raw(places))


@pytest.mark.parametrize("suffix", [".npy", "-big-endian.npy", ".csv", ".png", ".tif"])
def test_profiles_come_in_from_every_format(tmp_path: Path, suffix: str):
    places = profiles()
    folder = described(tmp_path / "f", f"map{suffix}")
    write(folder / f"map{suffix}", places)
    imported = uwlts.import_images(folder, tmp_path / "a.h5")
    assert (imported.laser, imported.lamp, imported.warnings) == (4, 0, ())
    with Capture(tmp_path / "a.h5") as capture:
        found = find_stripes(capture, options={"end_lines": 0})
        assert not capture.has_image.any() and capture.stage_mm.tolist() == [5.0, 5.5, 6.0, 6.5]
        good = np.isfinite(places)
        assert np.array_equal(np.stack([found.frame, found.line]), np.stack(np.nonzero(good)))
        assert np.array_equal(found.centre_px, places[good]) and np.isnan(found.amplitude).all()
        assert found.lines_by_status["ok"] == good.sum() and found.lines_by_status["no_stripe"] == (~good).sum()
        with pytest.raises(ImageError, match="frame 2 of a.h5 is a centre line.* where an image is needed"):
            capture.image(2)
    assert "4 with the laser on, 4 of them centre lines" in uwlts.describe(tmp_path / "a.h5")


def test_lamp_images_and_centre_lines_mix_and_come_back_from_an_export(tmp_path: Path):
    places = profiles(2)
    folder = described(tmp_path / "f", "map.png", lamp="w*.png")
    write(folder / "map.png", places)
    for number in (1, 2):
        cv2.imwrite(str(folder / f"w{number}.png"), lamp_image(number))
    uwlts.import_images(folder, tmp_path / "a.h5")
    uwlts.export(tmp_path / "a.h5", tmp_path / "out")
    assert uwlts.import_images(tmp_path / "out", tmp_path / "b.h5").warnings == ()
    for name in "ab":
        with Capture(tmp_path / f"{name}.h5") as capture:
            assert capture.has_image.tolist() == [True, False] * 2
            assert np.array_equal(capture.image(2), lamp_image(2))
            assert [index for index, _ in capture.frames(laser_on=False)] == [0, 2]
            for number, frame in ((0, 1), (1, 3)):
                assert np.array_equal(capture.read_observation(frame).centre_px, places[number], equal_nan=True)


def test_a_table_gives_encoder_and_time_of_every_profile(tmp_path: Path):
    folder = described(tmp_path / "f", "map.npy", stage={"direction": [1.0, 0.0, 0.0]})
    table = {"scale": SCALE, "offset": OFFSET, "invalid": 0, "table": "profiles.csv", "mm_per_count": 0.0125}
    described(folder, "map.npy", stage={"direction": [1.0, 0.0, 0.0]}, centre_lines=table)
    write(folder / "map.npy", profiles(3))
    (folder / "profiles.csv").write_text("encoder, time_s\n100, 0.5\n180, 0.51\n-20, 0.6\n")
    assert uwlts.import_images(folder, tmp_path / "a.h5").warnings == ()
    with Capture(tmp_path / "a.h5") as capture:
        assert np.allclose(capture.stage_mm, [1.25, 2.25, -0.25], atol=1e-12)
        assert capture.encoder.tolist() == [100, 180, -20] and capture.time_s.tolist() == [0.5, 0.51, 0.6]
        assert capture[1].encoder == 180
    (folder / "profiles.csv").write_text("encoder\n4294967286\n4294967294\n6\n")
    uwlts.import_images(folder, tmp_path / "wrapped.h5")
    with Capture(tmp_path / "wrapped.h5") as capture:
        assert np.allclose(np.diff(capture.stage_mm), 0.1, atol=1e-6)
        assert capture.encoder.tolist() == [4294967286, 4294967294, 6]
    (folder / "profiles.csv").write_text("encoder, time_s\n100, 0.5\n")
    with pytest.raises(DescriptionError, match=r"profiles.csv has 1 rows, the laser files 3 profiles"):
        uwlts.import_images(folder, tmp_path / "b.h5")


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        (np.zeros((2, WIDTH + 1)), "expected profiles in rows"),
        (np.zeros((WIDTH, 3)), "it may be transposed"),
        (np.full((2, WIDTH), 60_000), "range from 3748 to 3748 px.*check scale"),
        (np.zeros((1, 5, WIDTH)), "expected profiles in rows"),
        (np.array(["a"]), "no numbers"),
    ],
)
def test_numbers_that_cannot_be_are_refused(tmp_path: Path, numbers, words):
    folder = described(tmp_path / "f", "map.npy")
    np.save(folder / "map.npy", numbers)
    with pytest.raises(ImageError, match=words):
        uwlts.import_images(folder, tmp_path / "a.h5")
    assert not (tmp_path / "a.h5").exists() and not (tmp_path / "a.h5.part").exists()


def test_a_capture_without_any_stripe_says_so(tmp_path: Path):
    folder = described(tmp_path / "f", "map.npy")
    np.save(folder / "map.npy", np.zeros((2, WIDTH)))
    assert "no stripe in any of the 2" in uwlts.import_images(folder, tmp_path / "a.h5").warnings[0]
    with Capture(tmp_path / "a.h5") as capture, pytest.raises(CaptureError, match="no stripe in any of the 2 centre"):
        find_stripes(capture)


def test_amplitude_width_and_status_are_kept_and_damage_is_found(tmp_path: Path):
    folder = described(tmp_path / "f", "map.npy")
    write(folder / "map.npy", profiles(1))
    uwlts.import_images(folder, tmp_path / "a.h5")
    rows = np.stack([np.full(WIDTH, 20.5), np.full(WIDTH, 80.0), np.full(WIDTH, 3.5), np.zeros(WIDTH)])
    rows[3, 0] = StripeStatus.SATURATED
    stripe = Coordinates().stripe(rows, stripe_along="width", length_px=HEIGHT)
    assert np.isnan(stripe.centre_px[0]) and stripe.status[0] == StripeStatus.SATURATED
    with Capture(tmp_path / "a.h5") as capture:
        header = capture.header
    with CaptureWriter(tmp_path / "b.h5", header, dtype=np.dtype(np.uint8), centre_lines=True) as writer:
        writer.append(Frame(stripe, 0.0, True, 1.0, 0.0, encoder=7.0))
        with pytest.raises(ImageError, match="image with the laser on, the capture holds centre lines"):
            writer.append(Frame(lamp_image(), 0.0, True, 1.0, 0.0))
    with Capture(tmp_path / "b.h5") as capture:
        kept = capture.read_observation(0)
        assert np.array_equal(kept.status, stripe.status)
        assert np.array_equal(kept.amplitude, stripe.amplitude, equal_nan=True)
        assert find_stripes(capture).width_px.tolist() == [3.5] * (WIDTH - 1)


def test_the_ends_of_a_centre_line_are_left_out_as_those_of_an_image(tmp_path: Path):
    folder = described(tmp_path / "f", "map.npy")
    places = np.full((1, WIDTH), 20.0)
    places[0, 30:40] = np.nan
    write(folder / "map.npy", places)
    uwlts.import_images(folder, tmp_path / "a.h5")
    with Capture(tmp_path / "a.h5") as capture:
        left_out = set(range(WIDTH)) - set(find_stripes(capture).line.tolist())
        # Two lines on either side of the gap, by StripeOptions; the image's border is not an end.
        assert left_out == set(range(28, 42)) and find_stripes(capture).lines_by_status["end"] == 4


def test_centre_lines_of_another_length_are_refused(tmp_path: Path):
    folder = described(tmp_path / "f", "map.npy")
    write(folder / "map.npy", profiles(1))
    uwlts.import_images(folder, tmp_path / "a.h5")
    with Capture(tmp_path / "a.h5") as capture:
        header, stripe = capture.header, capture.read_observation(0)
    with CaptureWriter(tmp_path / "c.h5", header, dtype=np.dtype(np.uint8)) as writer:
        with pytest.raises(ImageError, match=f"centre line of {WIDTH} lines, the capture holds images"):
            writer.append(Frame(stripe, 0.0, True, 1.0, 0.0))
        writer.append(Frame(lamp_image(), 0.0, True, 1.0, 0.0))


def test_an_interrupted_recording_keeps_its_centre_lines_and_goes_on(tmp_path: Path):
    folder = described(tmp_path / "f", "map.npy")
    write(folder / "map.npy", profiles(3))
    uwlts.import_images(folder, tmp_path / "a.h5")
    with Capture(tmp_path / "a.h5") as capture:
        header, frames = capture.header, list(capture)
    written = {"dtype": np.dtype(np.uint8), "centre_lines": True}
    with pytest.raises(KeyboardInterrupt), CaptureWriter(tmp_path / "b.h5", header, **written) as writer:
        writer.append(frames[0])
        raise KeyboardInterrupt
    with pytest.raises(CaptureError, match="belongs to another recording"):
        CaptureWriter(tmp_path / "b.h5", header, dtype=np.dtype(np.uint8), resume=True)
    with CaptureWriter(tmp_path / "b.h5", header, **written, resume=True) as writer:
        for frame in frames[1:]:
            writer.append(frame)
    with Capture(tmp_path / "a.h5") as one, Capture(tmp_path / "b.h5") as other:
        assert len(other) == 3
        for k in range(3):
            assert np.array_equal(
                one.read_observation(k).centre_px, other.read_observation(k).centre_px, equal_nan=True
            )


def test_an_array_that_begins_like_an_archive_is_refused(tmp_path: Path):
    folder = described(tmp_path / "f", "map.npy")
    (folder / "map.npy").write_bytes(b"PK\x03\x04" + bytes(100))
    with pytest.raises(ImageError, match="is no NPY array"):
        uwlts.import_images(folder, tmp_path / "a.h5")
