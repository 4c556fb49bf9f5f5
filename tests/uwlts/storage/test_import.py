"""Import of foreign images as a capture: formats, channels, bits, positions, and refusals with their cause."""

import contextlib
import struct
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import tomli_w

from uwlts import cli
from uwlts.errors import DescriptionError, ImageError, OutputError
from uwlts.files.reading import natural_key
from uwlts.runtime.console import run
from uwlts.storage.capture import NO_STAGE, Capture, part_path
from uwlts.storage.export_ import export
from uwlts.storage.image_file import SUFFIXES, read_image
from uwlts.storage.import_.folder import import_images
from uwlts.storage.import_.grey_values import extract_channel
from uwlts.storage.import_.matching import POSE_COLUMNS, read_rows
from uwlts.stripe import extract_stripe

WIDTH, HEIGHT = 96, 64
SENSOR = {
    "base": "thesis",
    "name": "small",
    "camera": {"width_px": WIDTH, "height_px": HEIGHT, "stripe_along": "width"},
}
SHAPE = (HEIGHT, WIDTH)
GIVEN = {
    "sensor": SENSOR,
    "medium": "water",
    "laser": "*.png",
    "stage": {"start_mm": 5.0, "step_mm": 0.5, "direction": [1.0, 0.0, 0.0]},
}


def stripe_image(row: float = 30.3, *, height: float = 150.0, dark: float = 10.0, seed: int = 0) -> np.ndarray:
    """(H, W) uint8: a Gaussian line along the width."""
    across = np.arange(HEIGHT)[:, None] - np.full(WIDTH, row)
    noise = np.random.default_rng(seed).normal(0, 1, across.shape)
    return np.clip(dark + height * np.exp(-((across / 1.5) ** 2) / 2) + noise, 0, 255).round().astype(np.uint8)


def lamp_image(seed: int = 0) -> np.ndarray:
    """(H, W) uint8: stripes of a lit scene."""
    scene = 60 + 50 * np.sin(np.arange(WIDTH) / 3)
    return np.clip(np.random.default_rng(seed).normal(scene, 2, (HEIGHT, WIDTH)), 0, 255).astype(np.uint8)


def folder_of(tmp_path: Path, images: dict[str, np.ndarray], given: dict | None = None) -> Path:
    folder = tmp_path / "images"
    for name, image in images.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(folder / name), image)
    (folder / "import.toml").write_text(tomli_w.dumps(GIVEN if given is None else given))
    return folder


@contextlib.contextmanager
def imported(folder: Path, *, overwrite: bool = False) -> Iterator[Capture]:
    """Import a folder, and open the capture beside it."""
    import_images(folder, folder.parent / "a.h5", overwrite=overwrite)
    with Capture(folder.parent / "a.h5") as capture:
        yield capture


def three(tmp_path: Path, given: dict | None = None, **others: np.ndarray) -> Path:
    images = {f"l{number}.png": stripe_image(20.0 + number, seed=number) for number in (1, 2, 3)}
    return folder_of(tmp_path, images | {f"{name}.png": image for name, image in others.items()}, given)


def without(*keys: str, **changes) -> dict:
    return {key: value for key, value in GIVEN.items() if key not in keys} | changes


# --- accepted inputs


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_every_format_comes_in(tmp_path: Path, suffix: str):
    image = stripe_image()
    folder = folder_of(tmp_path, {f"a{suffix}": image}, without("laser", laser=f"*{suffix}"))
    assert import_images(folder, tmp_path / "a.h5").warnings == ()
    with Capture(tmp_path / "a.h5") as capture:
        error = np.abs(capture.image(0).astype(int) - image)
        # JPEG at OpenCV's quality of 95 quantises the cosines by a few grey levels.
        assert error.max() <= (12 if suffix in (".jpg", ".jpeg") else 0)


def tiff_of(image: np.ndarray, *, photometric: int, order: str) -> bytes:
    """Return an uncompressed TIFF file of one strip in an order of bytes, < or >."""
    (height, width), data = image.shape, image.astype(image.dtype.newbyteorder(order)).tobytes()
    tags = {256: width, 257: height, 258: 8 * image.itemsize, 259: 1, 262: photometric, 273: 8, 277: 1, 278: height}
    tags[279] = len(data)
    entries = b"".join(struct.pack(order + "HHII", tag, 4, 1, value) for tag, value in tags.items())
    start = {"<": b"II*\0", ">": b"MM\0*"}[order] + struct.pack(order + "I", 8 + len(data))
    return start + data + struct.pack(order + "H", len(tags)) + entries + bytes(4)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("order", ["<", ">"])
def test_white_may_be_zero_in_a_tiff(tmp_path: Path, dtype: type, order: str):
    image = stripe_image().astype(dtype) * (1 if dtype == np.uint8 else 200)
    for photometric, stored in ((1, image), (0, np.iinfo(dtype).max - image)):
        (tmp_path / "a.tif").write_bytes(tiff_of(stored, photometric=photometric, order=order))
        assert np.array_equal(read_image(tmp_path / "a.tif"), image)


def test_everything_described_is_in_the_capture(tmp_path: Path):
    target = {"kind": "chessboard", "columns": 9, "rows": 6, "square_mm": 15.0}
    artefact = {"kind": "step", "height_mm": 23.17}
    given = without("laser", laser="l*", lamp="w*", exposure_ms=4.0, lamp_exposure_ms=9.0, target=target, name="bench")
    images = {f"l{n}.png": stripe_image(20.0 + n) for n in (8, 10, 9)} | {
        f"w{n}.png": lamp_image(n) for n in (8, 9, 10)
    }
    folder = folder_of(tmp_path, images, given | {"artefact": artefact})
    imported = import_images(folder, tmp_path / "a.h5")
    assert (imported.laser, imported.lamp, imported.warnings) == (3, 3, ())
    with Capture(tmp_path / "a.h5") as capture:
        header = capture.header
        assert (header.name, header.medium_name, header.target, header.artefact) == ("bench", "water", target, artefact)
        assert (header.stage_direction, header.saturation_dn, capture.dtype) == ((1.0, 0.0, 0.0), 255, np.uint8)
        assert header.sensor.camera.width_px == WIDTH and header.sensor.laser.wavelength_nm == 635.0
        assert header.provenance["source"] == "imported images" and "time" in header.provenance
        assert "exposure" not in header.provenance
        assert capture.stage_mm.tolist() == [5.0, 5.0, 5.5, 5.5, 6.0, 6.0]
        assert capture.laser_on.tolist() == [False, True] * 3
        assert capture.exposure_ms.tolist() == [9.0, 4.0] * 3
        for index, name in enumerate(("w8", "l8", "w9", "l9", "w10", "l10")):
            assert np.array_equal(capture.image(index), images[f"{name}.png"])


def test_names_are_sorted_as_people_count():
    names = ["b2", "a10.png", "A9.png", "a1/f12", "a1/f2"]
    assert sorted(names, key=natural_key) == ["a1/f2", "a1/f12", "A9.png", "a10.png", "b2"]


def numbered(tmp_path: Path, laser: str, lamp: str = "", **given) -> tuple[list[float], tuple[str, ...]]:
    """Positions of imported images with these names, and warnings."""
    described = without("laser", laser="l*", lamp="w*", **given)
    images = {f"{name}.png": stripe_image(20 + n / 2, seed=n) for n, name in enumerate([*laser.split(), *lamp.split()])}
    warnings = import_images(folder_of(tmp_path, images, described), tmp_path / "a.h5").warnings
    with Capture(tmp_path / "a.h5") as capture:
        return capture.stage_mm.tolist(), warnings


@pytest.mark.parametrize(
    ("laser", "lamp", "positions", "missing"),
    [
        ("l1 l2 l4", "", [5, 5.5, 6.5], "1 file is missing"),
        ("l0004_x l0006_x l0012_x", "", [5, 5.5, 7], "2 files are missing"),
        ("l1 l2 l4", "w1 w3 w4", [5, 5, 5.5, 6, 6.5, 6.5], "1 file is missing"),
        ("l2 l4 l6 l10", "w1 w3 w5 w9", [5, 5, 5.5, 5.5, 6, 6, 7, 7], "1 file is missing"),
        ("l_0829_101158 l_0829_101159 l_0829_101200", "", [5, 5.5, 6], ""),
        ("l1a3_7 l1a4_8 l1a5_10", "", [5, 5.5, 6], ""),
        ("lb la lc", "", [5, 5.5, 6], ""),
    ],
)
def test_positions_follow_the_numbers_in_names(tmp_path: Path, laser, lamp, positions, missing):
    found, warnings = numbered(tmp_path, laser, lamp)
    assert sorted(found) == positions
    assert [missing in each for each in warnings] == [True] * (bool(missing) + (bool(missing) and bool(lamp)))


@pytest.mark.parametrize(
    ("names", "words"),
    [
        ("l1 l2 l02", "l2.png and l02.png have the same number|l02.png and l2.png have the same number"),
        ("l1 l2 l-3", "l1.png and l-3.png are named in different ways"),
        ("l1 l2 l2_copy", "are named in different ways"),
    ],
)
def test_names_that_do_not_tell_the_order_are_refused(tmp_path: Path, names, words):
    with pytest.raises(DescriptionError, match=words):
        numbered(tmp_path, names)


def test_a_table_against_the_numbers_is_refused(tmp_path: Path):
    folder = three(tmp_path, without("laser", table="t.csv"))
    (folder / "t.csv").write_text("file,light\nl3.png,laser\nl2.png,laser\nl1.png,laser\n")
    with pytest.raises(DescriptionError, match="reverse order of their numbers"):
        import_images(folder, tmp_path / "a.h5")


def test_a_jump_of_the_times_is_a_warning(tmp_path: Path):
    names = [f"l{letter}.png" for letter in "abcdefgh"]
    given = without("laser", table="t.csv")
    folder = folder_of(tmp_path, {name: stripe_image(20.0 + n) for n, name in enumerate(names)}, given)
    times = 0.1 * np.array([0, 1, 2, 3, 5, 6, 7, 8])
    (folder / "t.csv").write_text(
        "file,light,time_s\n" + "".join(f"{n},laser,{t}\n" for n, t in zip(names, times, strict=True))
    )
    (warning,) = import_images(folder, tmp_path / "a.h5").warnings
    assert "jump by 0.2 s after image 4, ld.png, usually by 0.1 s" in warning


@pytest.mark.parametrize("channel", ["blue", "green", "red", "grey", "max"])
def test_the_chosen_channel_comes_in(tmp_path: Path, channel: str):
    blue, green, red = (lamp_image(seed) for seed in (1, 2, 3))
    red = np.maximum(red, stripe_image())
    folder = folder_of(tmp_path, {"a.png": np.dstack([blue, green, red])}, GIVEN | {"channel": channel})
    import_images(folder, tmp_path / "a.h5")
    # Luminance after ITU-R BT.601, as OpenCV documents it, rounded.
    luminance = 0.114 * blue + 0.587 * green + 0.299 * red
    wanted = {
        "blue": blue,
        "green": green,
        "red": red,
        "grey": luminance,
        "max": np.maximum(np.maximum(blue, green), red),
    }
    # A value calculated from several colours is stored with the zero that formulas have, to leave room for marks.
    zero, rounding = (256, 0.51) if channel == "grey" else (0, 0)
    with Capture(tmp_path / "a.h5") as capture:
        assert np.abs(capture.image(0) - zero - wanted[channel].astype(float)).max() <= rounding


def test_the_laser_s_light_is_separated_by_a_difference_of_colours(tmp_path: Path):
    rng = np.random.default_rng(4)
    red, green, blue = (rng.integers(0, 256, SHAPE, dtype=np.uint8) for _ in range(3))
    images = {f"{n}.png": np.dstack([blue, green, red]) for n in range(2)}
    both = {"laser": "*.png", "lamp": "*.png", "channel": "red - max(green, blue)", "lamp_channel": "green"}
    folder = folder_of(tmp_path, images, GIVEN | both)
    found = import_images(folder, tmp_path / "out.h5")
    assert (found.laser, found.lamp) == (2, 2)
    with Capture(tmp_path / "out.h5") as capture:
        assert capture.laser_on.tolist() == [False, True, False, True]
        # Zero laser light is 256, so that the sign of the remaining noise is kept.
        wanted = 256 + red.astype(int) - np.maximum(green, blue)
        wanted += 512 * (images["0.png"] == 255).any(axis=2)
        np.testing.assert_array_equal(capture.image(1), wanted)
        np.testing.assert_array_equal(capture.image(0), green)
        assert capture.header.saturation_dn == 511


@pytest.mark.parametrize(
    ("formula", "value"),
    [
        ("red - 0.5*(green + blue)", 200 - 60),
        ("-blue + 2*green", 180),
        ("min(red, green, blue)", 20),
        ("red/green", 2),
        ("grey - grey", 0),
        ("3*red", 255),
    ],
)
def test_formulas_of_channels(formula, value):
    image = np.empty((2, 3, 3), np.uint8)
    image[:] = 20, 100, 200
    np.testing.assert_array_equal(extract_channel(image, formula, name="a"), np.full((2, 3), value))


@pytest.mark.parametrize(
    "formula", ["red -", "red - infrared", "red.real", "abs(red)", "1 + 2", "max(red)", "__import__('os')", "red ** 2"]
)
def test_what_is_no_formula_of_channels_is_refused(tmp_path: Path, formula):
    folder = folder_of(tmp_path, {"l1.png": np.full(SHAPE, 9, np.uint8)}, GIVEN | {"channel": formula})
    refused(folder, tmp_path, DescriptionError, "channel: .*expected red, green, blue")


def test_colour_without_colours_needs_no_channel():
    image = stripe_image()
    assert np.array_equal(extract_channel(np.dstack([image] * 3), None, name="a"), image)


@pytest.mark.parametrize("suffix", [".png", ".tiff"])
@pytest.mark.parametrize("bits", [10, 12, 16])
@pytest.mark.parametrize("aligned", ["low", "high"])
def test_all_bits_come_in(tmp_path: Path, suffix: str, bits: int, aligned: str):
    image = stripe_image().astype(np.uint16) * 2 ** (bits - 8) + 1
    stored = image * 2 ** (16 - bits) if aligned == "high" else image
    given = without("laser", laser="a*", bits=bits, aligned=aligned)
    with imported(folder_of(tmp_path, {f"a{suffix}": stored}, given)) as capture:
        assert (capture.dtype, capture.header.saturation_dn) == (np.uint16, 2**bits - 1)
        assert np.array_equal(capture.image(0), image)


def test_a_background_is_subtracted_with_its_sign(tmp_path: Path):
    dark = [lamp_image(seed) for seed in (4, 5)]
    lit = [np.clip(scene.astype(int) + stripe_image(25.25, height=90, dark=0, seed=9), 0, 255) for scene in dark]
    images = {f"l{n}.png": image.astype(np.uint8) for n, image in enumerate(lit)}
    images |= {f"w{n}.png": image for n, image in enumerate(dark)}
    given = without("laser", laser="l*", lamp="w*", background="w*")
    with imported(folder_of(tmp_path, images, given)) as capture:
        assert (capture.dtype, capture.header.saturation_dn) == (np.uint16, 255 + 256)
        assert "256 added" in capture.header.provenance["background"]
        for index in range(2):
            assert np.array_equal(capture.image(2 * index), dark[index])
            difference = capture.image(2 * index + 1).astype(int) - 256
            assert np.array_equal(difference, lit[index].astype(int) - dark[index]) and difference.min() == 0
            # Read out as the stripe software does with the two images themselves.
            stored = extract_stripe(capture.image(2 * index + 1), stripe_along="width", saturation=511)
            pair = extract_stripe(images[f"l{index}.png"], stripe_along="width", background=dark[index])
            assert len(pair.lines) > 0.9 * WIDTH and np.array_equal(stored.lines, pair.lines)
            # float32 holds 256 more grey levels to 3e-5 of one, against a stripe of 90.
            assert np.abs(stored.centre_px - pair.centre_px)[pair.lines].max() < 1e-4


def test_backgrounds_with_other_numbers_are_refused(tmp_path: Path):
    images = {f"l{n}.png": stripe_image(seed=n) for n in (1, 2, 3)} | {f"w{n}.png": lamp_image(n) for n in (2, 3, 4)}
    folder = folder_of(tmp_path, images, without("laser", laser="l*", background="w*"))
    with pytest.raises(DescriptionError, match="numbers of laser and background images differ"):
        import_images(folder, tmp_path / "a.h5")
    for number in (4, 3, 2):  # numbers that interleave share none
        (folder / f"w{number}.png").rename(folder / f"w{number + 2}.png")
    import_images(folder, tmp_path / "a.h5")


def saturated_images() -> tuple[np.ndarray, np.ndarray]:
    """Return a stripe (H, W) in colour that is white in its middle, and the same view without laser."""
    dark = np.full((HEIGHT, WIDTH, 3), 150, np.uint8)
    stripe = stripe_image(25.25, height=90, dark=0, seed=9).astype(float)[:, :, None] / 90
    return np.clip(dark + stripe * (400, 400, 2000), 0, 255).astype(np.uint8), dark


@pytest.mark.parametrize(
    ("channel", "background"),
    [("red", True), ("grey", True), ("grey", False), ("red - max(green, blue)", False), ("red - green", True)],
)
def test_pixels_clipped_by_the_camera_are_known_in_what_is_calculated(tmp_path: Path, channel: str, background: bool):
    lit, dark = saturated_images()
    given = without("laser", laser="l*", channel=channel, **({"background": "dark*"} if background else {}))
    images = {"l.png": lit, "dark.png": dark} if background else {"l.png": lit}
    found = import_images(folder_of(tmp_path, images, given), tmp_path / "a.h5")
    assert "1 of 1 laser images are saturated on more than 50 % of their profile lines" in " ".join(found.warnings)
    with Capture(tmp_path / "a.h5") as capture:
        image, saturation = capture.image(0), capture.header.saturation_dn
    assert saturation == 511
    used = lit[:, :, 2] if channel == "red" else lit[:, :, 1:] if "blue" not in channel and channel != "grey" else lit
    clipped = (used == 255) if used.ndim == 2 else (used == 255).any(axis=2)
    assert 0 < clipped.mean() < 0.5 and np.array_equal(image >= saturation, clipped)
    export(tmp_path / "a.h5", tmp_path / "folder")
    import_images(tmp_path / "folder", tmp_path / "again.h5")
    with Capture(tmp_path / "again.h5") as capture:
        assert np.array_equal(capture.image(0), image) and capture.header.saturation_dn == saturation
    # The stripe is where the light is, although the formula is darkest in its white middle.
    stripe = extract_stripe(image, stripe_along="width", saturation=saturation)
    assert len(stripe.lines) > 0.9 * WIDTH and np.abs(stripe.centre_px[stripe.lines] - 25.25).max() < 1.0


def test_noise_below_the_background_stays_below_and_ignored_images_are_none(tmp_path: Path):
    images = {"l1.png": stripe_image(seed=1), "dark1.png": stripe_image(height=0, seed=2)}
    images["dark-spoilt.png"] = np.full(SHAPE, 90, np.uint8)
    given = without("laser", laser="l*", background="dark*", ignore="*spoilt*")
    with imported(folder_of(tmp_path, images, given)) as capture:
        assert len(capture) == 1
        difference = capture.image(0).astype(int) - 256
        assert np.array_equal(difference, images["l1.png"].astype(int) - images["dark1.png"]) and difference.min() < 0


def test_images_are_taken_as_stored_whatever_exif_says(tmp_path: Path):
    folder = folder_of(tmp_path, {"a.jpg": stripe_image()}, without("laser", laser="a*"))
    upright = read_image(folder / "a.jpg")
    # An Exif block with one entry: orientation 6, to be turned by a quarter turn.
    entry = b"\x01\x12\x00\x03\x00\x00\x00\x01\x00\x06\x00\x00"
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01" + entry + b"\0\0\0\0"
    content = (folder / "a.jpg").read_bytes()
    block = b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif
    (folder / "a.jpg").write_bytes(content[:2] + block + content[2:])
    assert cv2.imread(str(folder / "a.jpg")).shape[:2] == (WIDTH, HEIGHT)
    assert np.array_equal(read_image(folder / "a.jpg"), upright)


def test_free_poses_count_the_images(tmp_path: Path):
    given = without("laser", "stage", laser="l*", lamp="w*", stage={"free": True})
    folder = three(tmp_path, given, w1=lamp_image(1), w2=lamp_image(2), w3=lamp_image(3))
    with imported(folder) as capture:
        assert capture.stage_mm.tolist() == [0.0, 0.0, 1.0, 1.0, 2.0, 2.0]
        assert capture.header.provenance["stage"] == NO_STAGE
    folder_of(tmp_path, {}, given | {"provenance": {"operator": "me"}})
    with imported(folder, overwrite=True) as capture:
        assert capture.header.provenance == {"operator": "me", "stage": NO_STAGE}


@pytest.mark.parametrize("separator", [",", ";"])
def test_a_table_describes_each_image(tmp_path: Path, separator: str):
    pose = np.eye(4)
    pose[:3, 3] = 1.5, -2.25, 1 / 3
    cells = separator.join(repr(value) for value in pose.ravel().tolist())
    names = separator.join(f"pose_{row}{column}" for row in range(4) for column in range(4))
    lines = [
        f"file,light,stage_mm,exposure_ms,time_s,{names}",
        f"l3.png,laser,7.5,2,0.5,{cells}",
        f"w.png,lamp,0.125,3,1,{',' * 15}",
        f"l1.png,laser,-1e-3,2,2,{',' * 15}",
        f"l2.png,ignore,,,,{',' * 15}",
    ]
    given = without("laser", "stage", table="each.csv", stage={"direction": [0.0, 0.0, 1.0]})
    folder = three(tmp_path, given, w=lamp_image())
    (folder / "each.csv").write_text("\n".join(lines).replace(",", separator), encoding="utf-8-sig")
    assert import_images(folder, tmp_path / "a.h5").warnings == ()
    with Capture(tmp_path / "a.h5") as capture:
        assert capture.stage_mm.tolist() == [7.5, 0.125, -1e-3] and capture.time_s.tolist() == [0.5, 1.0, 2.0]
        assert capture.laser_on.tolist() == [True, False, True] and capture.exposure_ms.tolist() == [2.0, 3.0, 2.0]
        assert np.array_equal(capture.pose[0], pose) and np.isnan(capture.pose[1:]).all()


def test_patterns_say_which_image_is_what_where_the_table_has_positions_only(tmp_path: Path):
    given = without("stage", "laser", laser="l*", table="each.csv", stage={"direction": [0.0, 0.0, 1.0]})
    folder = three(tmp_path, given)
    (folder / "each.csv").write_text("file,stage_mm\nl2.png,4\nl1.png,3\n")
    imported = import_images(folder, tmp_path / "a.h5")
    assert len(imported.warnings) == 1 and "l3.png" in imported.warnings[0]
    with Capture(tmp_path / "a.h5") as capture:
        assert capture.stage_mm.tolist() == [4.0, 3.0]


def test_the_table_names_backgrounds(tmp_path: Path):
    given = without("laser", table="each.csv", stage={"positions_mm": [1.0, 2.0], "direction": [0.0, 0.0, 1.0]})
    folder = three(tmp_path, given, dark=stripe_image(height=0, dark=4))
    (folder / "each.csv").write_text("file,light,background\nl1.png,laser,dark.png\nl2.png,laser,dark.png\n")
    with imported(folder) as capture:
        assert capture.stage_mm.tolist() == [1.0, 2.0] and np.median(capture.image(0)) == pytest.approx(256 + 6, abs=1)


def test_intrinsics_fill_the_sensor(tmp_path: Path):
    folder = three(tmp_path, GIVEN | {"intrinsics": "camera.yaml"})
    matrix, coefficients = (
        np.array([[2000.0, 0, 50], [0, 2004, 31], [0, 0, 1]]),
        np.array([0.1, -0.2, 1e-3, 2e-3, 0.05]),
    )
    storage = cv2.FileStorage(str(folder / "camera.yaml"), cv2.FILE_STORAGE_WRITE)
    storage.write("camera_matrix", matrix)
    storage.write("distortion_coefficients", coefficients)
    storage.release()
    with imported(folder) as capture:
        camera = capture.header.sensor.camera
    assert camera.focal_length_px() == pytest.approx(2002.0, rel=1e-12)
    assert camera.principal_point() == (50.0, 31.0)
    assert tuple(camera.distortion.used_coefficients().values()) == tuple(coefficients)


# --- refusals


def refused(folder: Path, tmp_path: Path, error: type[Exception], words: str) -> None:
    """Check that an import fails with these words and leaves no files."""
    out = tmp_path / "refused.h5"
    with pytest.raises(error, match=words):
        import_images(folder, out)
    assert not out.exists() and not part_path(out).exists()


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("share", [0.05, 0.5, 0.97])
def test_truncated(tmp_path: Path, suffix: str, share: float):
    folder = folder_of(
        tmp_path, {f"a1{suffix}": lamp_image(), f"a2{suffix}": lamp_image()}, without("laser", laser="a*")
    )
    content = (folder / f"a2{suffix}").read_bytes()
    (folder / f"a2{suffix}").write_bytes(content[: int(share * len(content))])
    refused(folder, tmp_path, ImageError, f"a2{suffix} is a .* file that is truncated or damaged")


@pytest.mark.parametrize(("content", "words"), [(b"", "it is empty"), (b"\x7fELF\x02\x01", "it begins with b'.x7fELF")])
def test_foreign(tmp_path: Path, content: bytes, words: str):
    folder = three(tmp_path)
    (folder / "l2.png").write_bytes(content)
    refused(folder, tmp_path, ImageError, f"l2.png is no PNG, TIFF, BMP or JPEG image: {words}")


WHITE = np.where(np.arange(HEIGHT)[:, None] < HEIGHT // 3, 200, np.full(SHAPE, 255)).astype(np.uint8)


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (stripe_image()[:, :-2], "has 94 x 64 pixels; expected 96 x 64 .* and the images before it"),
        (stripe_image().T, "has 64 x 96 .*it is rotated by 90 deg"),
        (stripe_image().astype(np.uint16), "contains uint16, the images before it contain uint8"),
        (WHITE, "is white: 67 % of its pixels are saturated"),
        (np.dstack([stripe_image()] * 4), "has 4 channels, including an alpha channel"),
        (np.dstack([stripe_image(), lamp_image(), lamp_image()]), "is a colour image: choose the channel"),
    ],
)
def test_an_image_unlike_the_others_is_refused(tmp_path: Path, image: np.ndarray, words: str):
    refused(three(tmp_path, l2=image), tmp_path, ImageError, f"l2.png {words}")


@pytest.mark.parametrize(
    ("image", "given", "words"),
    [
        (stripe_image()[:-2], {}, "96 x 62 pixels; expected 96 x 64 .*sensor that took the images"),
        (stripe_image().T, {}, "64 x 96 pixels; .* rotated by 90 deg: rotate them back, or exchange"),
        (np.full(SHAPE, 1023, np.uint16), {"bits": 10}, "is white: 100 % .*1023 DN"),
        (stripe_image().astype(np.uint16), {}, "16 bit: give the number that the camera used"),
        (stripe_image().astype(np.uint16) * 16, {"bits": 10}, "exceeds 10 bits: .*'high'"),
        (stripe_image().astype(np.uint16) * 3, {"bits": 10, "aligned": "high"}, "more than its upper 10 bits"),
        (stripe_image(), {"bits": 10}, "a file of 8 bit, but bits = 10"),
        (stripe_image(), {"channel": "red - green"}, "a.png has no colours"),
        # Of the red stripe, only the black green channel.
        (
            np.dstack([0 * WHITE, 0 * WHITE, stripe_image()]),
            {"channel": "green"},
            "black.*the channel that of its colour",
        ),
    ],
)
def test_images_that_contradict_the_description_are_refused(tmp_path: Path, image, given: dict, words: str):
    refused(folder_of(tmp_path, {"a.png": image}, GIVEN | given), tmp_path, ImageError, words)


def test_all_black(tmp_path: Path):
    black = np.random.default_rng(0).integers(0, 4, (HEIGHT, WIDTH), dtype=np.uint8)
    black[10, 10] = 255  # a hot pixel
    folder = folder_of(tmp_path, {"l1.png": black, "l2.png": black})
    refused(folder, tmp_path, ImageError, "all 2 laser images are black.*is the laser on")
    target = {"kind": "chessboard", "columns": 9, "rows": 6, "square_mm": 15.0}
    given = without("laser", laser="l*", lamp="w*", target=target)
    images = {"l1.png": stripe_image(), "l2.png": stripe_image(), "w1.png": black, "w2.png": black}
    refused(folder_of(tmp_path, images, given), tmp_path, ImageError, "all 2 lamp images are black")


def stripes(count: int, **options) -> list[np.ndarray]:
    return [stripe_image(20.0 + number, seed=number, **options) for number in range(count)]


@pytest.mark.parametrize(
    ("images", "camera", "words"),
    [
        ([*stripes(2), np.zeros(SHAPE, np.uint8)], {}, "1 of 3 laser images are black, such as l2.png"),
        (stripes(2, height=0, dark=40), {}, "no stripe in any of the 2 laser images"),
        (
            [np.pad(stripe_image()[:, :80].T, ((0, 0), (8, 8)), "reflect")],
            {"width_px": 80, "height_px": 80},
            "one runs across: the images are rotated, or the sensor's stripe_along",
        ),
        ([255 - image for image in stripes(3)], {}, "are their grey values inverted?"),
    ],
    ids=["black", "no stripe", "across", "inverted"],
)
def test_images_that_show_no_stripe_are_imported_and_named(tmp_path: Path, images, camera, words: str):
    given = GIVEN | {"sensor": SENSOR | {"camera": SENSOR["camera"] | camera}}
    folder = folder_of(tmp_path, {f"l{number}.png": image for number, image in enumerate(images)}, given)
    warnings = import_images(folder, tmp_path / "a.h5").warnings
    assert words in warnings[0] and (len(warnings) == 1 or len(images) == 1 or "black" in words)
    with Capture(tmp_path / "a.h5") as capture:
        assert len(capture) == len(images)


def test_several_pages_and_floating_point(tmp_path: Path):
    assert cv2.imwritemulti(str(tmp_path / "pages.tif"), [stripe_image(), stripe_image()])
    with pytest.raises(ImageError, match=r"pages.tif holds several pages"):
        read_image(tmp_path / "pages.tif")
    assert cv2.imwrite(str(tmp_path / "float.tif"), stripe_image().astype(np.float32))
    with pytest.raises(ImageError, match="holds values of float32"):
        read_image(tmp_path / "float.tif")


def test_empty_folder(tmp_path: Path):
    folder = folder_of(tmp_path, {"l.png": stripe_image()})
    (folder / "l.png").unlink()
    (folder / ".l.png").write_bytes(b"hidden")
    refused(folder, tmp_path, ImageError, "holds no image")
    refused(tmp_path / "nowhere", tmp_path, ImageError, "no folder at")


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (without("stage", stage={"direction": [1.0, 0.0, 0.0]}), "positions of the stage are missing"),
        (GIVEN | {"stage": {"start_mm": 0.0, "direction": [1.0, 0.0, 0.0]}}, "start_mm and step_mm belong together"),
        (GIVEN | {"stage": {"positions_mm": [1.0, 2.0], "direction": [1.0, 0.0, 0.0]}}, "has 2 positions for 3 images"),
        (GIVEN | {"stage": {"start_mm": 0.0, "step_mm": 1.0}}, "stage.direction is missing"),
        (GIVEN | {"stage": {"start_mm": 0.0, "step_mm": 0.0}}, "l1.png and l2.png have the same position, 0 mm"),
        (GIVEN | {"stage": {"start_mm": 0.0, "step_mm": 1.0, "free": True}}, "give the positions once"),
        (GIVEN | {"stage": {"positions_mm": [1.0, 2.0, 1.0]}}, "l1.png and l3.png have the same position"),
        (GIVEN | {"exposure": 3.0}, "exposure: unknown key"),
        (GIVEN | {"stage": GIVEN["stage"] | {"stop_mm": 3.0}}, "stage.stop_mm: unknown key"),
        (GIVEN | {"channel": "infrared"}, "channel: .*found 'infrared'"),
        (without("sensor"), "sensor missing"),
        (GIVEN | {"medium": "milk"}, "knows the media air, water, not 'milk'"),
        (GIVEN | {"target": {"kind": "chessboard"}}, "columns is missing"),
        (GIVEN | {"laser": "scan*.png"}, "none of the 3 images"),
        (GIVEN | {"lamp": "l2*"}, "l2.png would be both laser and lamp image"),
        (GIVEN | {"background": "l2*"}, "l2.png would be both laser and background image"),
        (GIVEN | {"laser": "l1*", "background": "l[23]*"}, "2 background images for 1 laser images"),
        (GIVEN | {"laser": "l[12]*", "lamp": "l3*"}, "2 laser and 1 lamp images: it is unknown"),
        (GIVEN | {"header": "header.json"}, "the header gives sensor, medium, stage.direction already"),
        (GIVEN | {"saturation_dn": 1000}, "saturation_dn is 1000; images of uint8"),
    ],
)
def test_wrong_descriptions(tmp_path: Path, given: dict, words: str):
    refused(three(tmp_path, given), tmp_path, DescriptionError, words)


def test_sixteen_bits_leave_no_room_for_a_sign(tmp_path: Path):
    images = {"l.png": stripe_image().astype(np.uint16) * 200, "dark.png": stripe_image().astype(np.uint16)}
    given = GIVEN | {"laser": "l*", "background": "dark*", "bits": 16}
    refused(folder_of(tmp_path, images, given), tmp_path, DescriptionError, "16 bits leave no room for its sign")


OF_POSES = ",".join(["file", *POSE_COLUMNS])


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("file,stage_mm\n", "is empty"),
        ("file,stage\nl1.png,3\n", "columns file, stage; expected"),
        ("stage_mm\n3\n", "columns stage_mm; expected file"),
        ("file,stage_mm\nl1.png,3\nl1.png,4\n", "names l1.png more than once"),
        ("file,stage_mm\nl1.png,3\nl9.png,4\n", "names l9.png, which .* does not hold"),
        ("file,stage_mm\nl1.png,3\nl2.png,\n", "position of l2.png is missing"),
        ("file,stage_mm\nl1.png,3\nl2.png,3.0\n", "l1.png and l2.png have the same position, 3 mm"),
        ("file,stage_mm\nl1.png,3\nl2.png\n", "line 3: there are more or fewer cells"),
        ("file;stage_mm\nl1.png;3,5\n", "stage_mm is '3,5'; expected a number with a decimal point"),
        ("file,stage_mm\nl1.png,nan\n", "expected a finite number"),
        ("file,stage_mm\n../l1.png,1\n", "line 2: ../l1.png is outside the folder"),
        ("file,stage_mm,background\nl1.png,1,/l2.png\n", "line 2: /l2.png is outside the folder"),
        ("file,stage_mm\n,1\n", "line 2: the file's name is missing"),
        ("file,stage_mm,background\nl1.png,1,l2.png\nl3.png,2,\n", "a background for 1 of 2 laser images"),
        ("file,pose_00\nl1.png,1\n", "only 1 of the 16 elements"),
        (f"{OF_POSES}\nl1.png,1,0,0,0,0,1,0,0,0,0,1,0,5,0,0,1\n", "line 2: pose 1 .* column by column: expected row"),
        (f"{OF_POSES}\nl1.png,1,0,0,0,0,1,0,0,0,0,-1,0,0,0,0,1\n", "line 2: pose 1 .* It is a reflection"),
        ("file,light\nl1.png,laser\n", "column light, and there are patterns"),
        ("file,stage_mm,light\nl1.png,3,sun\n", "the light is 'sun'"),
    ],
)
def test_wrong_tables(tmp_path: Path, table: str, words: str):
    folder = three(tmp_path, without("stage", table="each.csv", stage={"direction": [1.0, 0.0, 0.0]}))
    (folder / "each.csv").write_text(table)
    refused(folder, tmp_path, DescriptionError, words)


def test_a_missing_table_and_description(tmp_path: Path):
    with pytest.raises(DescriptionError, match="no table at"):
        read_rows(tmp_path / "each.csv")
    folder = three(tmp_path)
    (folder / "import.toml").unlink()
    refused(folder, tmp_path, DescriptionError, "no description at .*import.toml")


def test_repeated_images_are_meant(tmp_path: Path):
    folder = three(tmp_path, GIVEN | {"stage": GIVEN["stage"] | {"step_mm": 0.0}, "repeated": True})
    assert import_images(folder, tmp_path / "a.h5").laser == 3


def test_an_existing_capture_stays(tmp_path: Path):
    folder, out = three(tmp_path), tmp_path / "a.h5"
    out.write_bytes(b"precious")
    with pytest.raises(OutputError, match="exists already"):
        import_images(folder, out)
    assert out.read_bytes() == b"precious"
    import_images(folder, out, overwrite=True)
    with Capture(out) as capture:
        assert len(capture) == 3


def test_an_interruption_leaves_nothing(tmp_path: Path):
    def interrupt(done: int, total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with contextlib.suppress(KeyboardInterrupt):
        import_images(three(tmp_path), tmp_path / "a.h5", progress=interrupt)
    assert [path.name for path in tmp_path.iterdir()] == ["images"]


def test_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    folder = three(tmp_path, l4=np.dstack([stripe_image(), lamp_image(), lamp_image()]))
    monkeypatch.setattr("sys.argv", ["uwlts", "import", str(folder), "--out", str(tmp_path / "a.h5")])
    assert run(cli.app) == 2
    assert "error: l4.png is a colour image" in capsys.readouterr().err
    (folder / "import.toml").write_text(tomli_w.dumps(GIVEN | {"laser": "l[123].png"}))
    assert run(cli.app) == 0
    printed = capsys.readouterr()
    assert "with 3 laser and 0 lamp images" in printed.out and "warning: 1 images of the folder" in printed.err


def test_a_formula_leaves_lamp_images_grey(tmp_path: Path):
    colours = np.dstack([lamp_image(1), lamp_image(2), np.maximum(lamp_image(3), stripe_image())])
    given = without("laser", laser="*.png", lamp="*.png", channel="red - max(green, blue)")
    with imported(folder_of(tmp_path, {"a1.png": colours, "a2.png": colours[::-1]}, given)) as capture:
        assert np.array_equal(capture.image(0), cv2.cvtColor(colours, cv2.COLOR_BGR2GRAY)) and not capture.laser_on[0]
        assert "not known" in capture.header.provenance["response"]
