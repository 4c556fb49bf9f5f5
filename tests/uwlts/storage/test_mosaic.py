"""Raw Bayer images: recognised among grey images of all kinds, and demosaiced."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.uwlts.storage.test_import import GIVEN, HEIGHT, WIDTH, folder_of, stripe_image
from uwlts.errors import ImageError
from uwlts.storage.capture import Capture
from uwlts.storage.import_.folder import import_images
from uwlts.storage.import_.grey_values import demosaic, is_mosaic

PATTERNS = ("RGGB", "GRBG", "GBRG", "BGGR")
RED, GREEN, BLUE = (1.0, 0.08, 0.01), (0.1, 1.0, 0.2), (0.02, 0.3, 1.0)


def a_scene(seed: int, *, angle: float = 0.1, width: float = 2.0) -> np.ndarray:
    """Return a stripe (H, W) of 150 DN over a dark background."""
    rows, columns = np.mgrid[:160, :200]
    across = (rows - 80.3) * np.cos(angle) + (columns - 100) * np.sin(angle) + 3 * np.sin(columns / 40 + seed)
    return 150 * np.exp(-((across / width) ** 2) / 2)


def raw_image(light: np.ndarray, pattern: str, colour: tuple[float, float, float], *, noise: float = 2.0) -> np.ndarray:
    """Return the mosaic (H, W) uint8 of light (H, W) of one colour, with the camera's offset of 8 DN."""
    gain = dict(zip("RGB", colour, strict=True))
    raw = light * np.tile(
        np.array([gain[each] for each in pattern]).reshape(2, 2), (light.shape[0] // 2, light.shape[1] // 2)
    )
    noisy = 8 + raw + np.random.default_rng(1).normal(0, noise, light.shape)
    return np.clip(noisy.round(), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("colour", [RED, GREEN, BLUE], ids=["red", "green", "blue"])
@pytest.mark.parametrize("noise", [0.0, 2.0, 10.0])
def test_a_mosaic_is_recognised(pattern: str, colour: tuple[float, float, float], noise: float):
    assert is_mosaic(raw_image(a_scene(1), pattern, colour, noise=noise))


@pytest.mark.parametrize("angle", [0.0, 0.02, np.pi / 4, np.pi / 2])
@pytest.mark.parametrize("width", [0.7, 1.0, 3.0])
@pytest.mark.parametrize("noise", [0.0, 2.0, 10.0])
def test_a_stripe_of_a_grey_camera_is_no_mosaic(angle: float, width: float, noise: float):
    grey = (1.0, 1.0, 1.0)
    assert not is_mosaic(raw_image(a_scene(2, angle=angle, width=width), "RGGB", grey, noise=noise))


def test_other_images_are_no_mosaic():
    rng = np.random.default_rng(3)
    noise = rng.integers(0, 256, (120, 120), dtype=np.uint8)
    interlaced = np.where(np.arange(120)[:, None] % 2 == 0, 60, 100).astype(np.uint8).repeat(120, axis=1)
    squares = (200 * ((np.mgrid[:120, :120] // 7).sum(axis=0) % 2)).astype(np.uint8)
    for image in (noise, interlaced, interlaced.T, squares, np.full((120, 120), 9, np.uint8), noise[:3, :3]):
        assert not is_mosaic(np.ascontiguousarray(image))


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_demosaicing_returns_each_colour(pattern: str, dtype: type):
    light = np.full((16, 16), 100.0)
    raw = raw_image(light, pattern, (1.0, 0.5, 0.25), noise=0.0).astype(dtype)
    found = demosaic(raw, pattern, name="a.png")
    assert found.dtype == dtype
    assert found[4:-4, 4:-4].reshape(-1, 3).tolist() == [[33, 58, 108]] * 64
    with pytest.raises(ImageError, match="a colour image, which has no Bayer pattern: leave bayer out"):
        demosaic(found, pattern, name="a.png")


def test_an_import_of_raw_images(tmp_path: Path):
    images = {f"l{n}.png": stripe_image(30.3 + n, dark=0.0, height=200.0, seed=n) for n in range(3)}
    tile = np.tile([[1.0, 0.1], [0.1, 0.02]], (HEIGHT // 2, WIDTH // 2))
    raw = {name: (image * tile).round().astype(np.uint8) for name, image in images.items()}
    folder = folder_of(tmp_path, raw)
    (warning,) = import_images(folder, tmp_path / "raw.h5").warnings
    assert "l0.png looks like a raw Bayer image" in warning and "bayer = 'RGGB'" in warning
    folder_of(tmp_path, raw, GIVEN | {"bayer": "RGGB", "channel": "red"})
    assert import_images(folder, tmp_path / "red.h5").warnings == ()
    with Capture(tmp_path / "red.h5") as capture:
        assert capture.header.provenance["bayer"] == "RGGB"
        # Samples of the red pixels are unchanged.
        assert (capture.image(0)[2:-2:2, 2:-2:2] == raw["l0.png"][2:-2:2, 2:-2:2]).all()


def test_an_import_of_equal_neighbours(tmp_path: Path):
    images = {f"l{n}.png": stripe_image(20.0 + n, seed=n) for n in (1, 2, 4)}
    images["l3.png"] = images["l2.png"]
    (warning,) = import_images(folder_of(tmp_path, images), tmp_path / "a.h5").warnings
    assert "1 of 4 laser images are equal to the one before, such as l3.png" in warning
    assert cv2.imwrite(str(tmp_path / "images" / "l3.png"), stripe_image(23.0, seed=3))
    assert import_images(tmp_path / "images", tmp_path / "a.h5", overwrite=True).warnings == ()
