"""Colours that the lens magnifies differently: photographs of a chessboard whose red is magnified on purpose."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from uwlts.storage.import_ import import_images
from uwlts.storage.import_.chromatic import chromatic_warnings
from uwlts.targets import ChessboardTarget

PHOTOGRAPHS = Path(__file__).parents[2] / "data" / "etna"
BOARD = ChessboardTarget(columns=7, rows=6, square_mm=10.0)


def coloured(folder: Path, *, magnified: float = 1.0, moved_px: float = 0.0) -> list[Path]:
    """Photographs in colour, their red moved to the right and magnified about the middle."""
    paths = []
    for number in (1, 14):
        grey = cv2.imread(str(PHOTOGRAPHS / f"frame{number:04}.jpg"), cv2.IMREAD_GRAYSCALE)
        middle = np.array(grey.shape[::-1]) / 2
        matrix = np.column_stack([magnified * np.eye(2), (1 - magnified) * middle + [moved_px, 0.0]])
        red = cv2.warpAffine(grey, matrix, grey.shape[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        paths.append(folder / f"lamp{number}.png")
        cv2.imwrite(str(paths[-1]), np.dstack([grey, grey, red]))
    return paths


@pytest.mark.parametrize(
    ("magnified", "moved_px", "corner_px"), [(1.001, 0.0, 0.82), (0.9992, 0.0, 0.66), (1.0, 0.5, 0.5)]
)
def test_what_lies_apart_in_two_colours_is_told(tmp_path, magnified, moved_px, corner_px):
    images = coloured(tmp_path, magnified=magnified, moved_px=moved_px)
    (warning,) = chromatic_warnings(images, BOARD, lamp_channel="green", wavelength_nm=635.0)
    found = [float(word) for word in warning.replace(",", "").split() if word[0].isdigit()]
    # Corners of two images, all over them, scatter by less than a tenth of a pixel against themselves.
    assert found[0] == pytest.approx(magnified, abs=2e-4)
    assert found[1] == pytest.approx(moved_px, abs=0.1)
    assert found[2] == pytest.approx(corner_px, abs=0.2)
    assert warning.endswith("lamp_channel = 'red'")


def test_colours_that_lie_together_and_one_colour_for_both_give_no_warning(tmp_path):
    alike = coloured(tmp_path)
    assert chromatic_warnings(alike, BOARD, lamp_channel="grey", wavelength_nm=635.0) == []
    apart = coloured(tmp_path, magnified=1.001)
    for channel in ("red", None):
        assert chromatic_warnings(apart, BOARD, lamp_channel=channel, wavelength_nm=635.0) == []
    assert chromatic_warnings([PHOTOGRAPHS / "frame0001.jpg"], BOARD, lamp_channel="green", wavelength_nm=450.0) == []


def described(folder: Path, *, channel: str, lamp_channel: str) -> Path:
    """The folder with a description of its photographs, each a laser image and a lamp image."""
    (folder / "import.toml").write_text(
        f"""
medium = "air"
laser = "lamp*.png"
lamp = "lamp*.png"
channel = "{channel}"
lamp_channel = "{lamp_channel}"
stage = {{free = true}}
sensor = {{base = "thesis", camera = {{stripe_along = "height", window = {{mounted = false}}}}}}
target = {{kind = "chessboard", columns = 7, rows = 6, square_mm = 10.0}}
"""
    )
    return folder


def test_an_import_tells_it(tmp_path):
    coloured(tmp_path, magnified=1.001)
    folder = described(tmp_path, channel="red", lamp_channel="green")
    warnings = import_images(folder, tmp_path / "a.h5").warnings
    assert any("red is magnified by 1.001" in each for each in warnings)


@pytest.mark.parametrize("lamp_channel", ["green", "red - max(green, blue)", "2 * green - red"])
def test_an_import_succeeds_where_a_colour_does_not_show_the_target(tmp_path, lamp_channel):
    # The board is in green and blue alone: the first looks for it in red too, the others do not find or do see it.
    for path in coloured(tmp_path):
        image = cv2.imread(str(path))
        image[..., 2] = 40
        image[:, 300:303, 2] = 200
        cv2.imwrite(str(path), image)
    imported = import_images(described(tmp_path, channel="red", lamp_channel=lamp_channel), tmp_path / "a.h5")
    assert (imported.laser, imported.lamp) == (2, 2)
    assert not any("magnified" in each for each in imported.warnings)
