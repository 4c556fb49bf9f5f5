"""Detection of the stripe on a flat target among other bright parts of the image."""

import cv2
import numpy as np
import pytest

from uwlts.calibration.target_stripes import stripe_on_target
from uwlts.targets import ChessboardTarget, TargetView

BOARD = ChessboardTarget(columns=8, rows=6, square_mm=10.0)
SIZE = (640, 512)
PX_PER_MM, FIRST = 5.0, (150.0, 120.0)
# The plate reaches two squares beyond the corners' rows and columns, and the search a little farther.
PLATE = ChessboardTarget(columns=8, rows=6, square_mm=10.0, margin_mm=10.0)


def seen() -> TargetView:
    """A board seen squarely."""
    points = np.column_stack([BOARD.indices * BOARD.square_mm, np.zeros(len(BOARD.indices))])
    return TargetView(points[:, :2] * PX_PER_MM + FIRST, points, BOARD.indices, {})


def curve(rows: np.ndarray) -> np.ndarray:
    return 300.0 + 0.12 * (rows - 250.0) - 2e-4 * (rows - 250.0) ** 2


def lit(rows: np.ndarray, across: np.ndarray, *, height: float, sigma: float = 1.8) -> np.ndarray:
    """Light (H, W) of a line at (N,) columns of (N,) rows."""
    image = np.zeros(SIZE[::-1])
    image[rows] = height * np.exp(-0.5 * ((np.arange(SIZE[0]) - across[:, None]) / sigma) ** 2)
    return image


def grey(light: np.ndarray) -> np.ndarray:
    noise = np.random.default_rng(3).normal(0, 1.5, light.shape)
    return np.clip(np.rint(light + 8 + noise), 0, 255).astype(np.uint8)


ROWS = np.arange(SIZE[1])
LINE = lit(ROWS, curve(ROWS), height=120)
SOME = ROWS[(ROWS // 16) % 3 == 0]
OTHERS = {
    "nothing": 0 * LINE,
    "brighter reflections on a third of the lines": lit(SOME, curve(SOME) + 60 * np.sin(SOME / 9.0) + 90, height=200),
    "a second line": lit(ROWS[200:300], curve(ROWS[200:300]) - 70.0, height=110),
    "a bright spot on the line's side": 230.0 * cv2.circle(np.zeros(SIZE[::-1]), (330, 250), 22, 1.0, -1),
}


@pytest.mark.parametrize("turned", [False, True], ids=["rows", "columns"])
@pytest.mark.parametrize("other", OTHERS.values(), ids=OTHERS)
def test_the_stripe_is_one_smooth_curve(other: np.ndarray, turned: bool):
    image, view = grey(LINE + other), seen()
    if turned:
        image = np.ascontiguousarray(image.T)
        view = TargetView(view.pixels[:, ::-1], view.points_mm, view.indices, {})
    found = stripe_on_target(image, view, PLATE, stripe_along="width" if turned else "height", saturation=255.0)
    across, rows = found.pixels[:, ::-1].T if turned else found.pixels.T
    # The plate is 70 mm high, and sought 5 % farther.
    on_plate = np.arange(70, 420)
    assert np.isin(on_plate, rows).mean() > (0.85 if other.max() > 220 else 0.97)
    assert rows.min() > 50 and rows.max() < 440
    away = across - curve(rows)
    assert np.sqrt(np.mean(away**2)) < (0.3 if other.max() > 220 else 0.1) and np.abs(away).max() < 1.5
    assert (found.outliers > 50) == (other.max() == 200)


def test_an_image_without_a_curve_gives_no_stripe():
    rng = np.random.default_rng(5)
    image = grey(lit(ROWS, rng.uniform(150, 450, len(ROWS)), height=150))
    found = stripe_on_target(image, seen(), PLATE, stripe_along="height", saturation=255.0)
    assert len(found.pixels) < 60
