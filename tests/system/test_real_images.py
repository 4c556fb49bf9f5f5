"""Photographs that nobody of this project made, of the Ciclop scanner and of dots, and what the software makes of them.

They lie beside the project where their licence leaves them, and are not part of it.
"""

from pathlib import Path

import cv2
import numpy as np
import pytest

from uwlts.calibration.camera import solve_camera
from uwlts.calibration.evidence import air_evidence
from uwlts.calibration.intrinsics import CameraOptions
from uwlts.storage.capture import Capture
from uwlts.storage.import_ import import_images
from uwlts.stripe import PeakRule, StripeOptions, extract_stripe
from uwlts.targets.detection import detect_lattice

PHOTOGRAPHS = Path(__file__).resolve().parents[3] / "shared" / "real" / "ciclop"
pytestmark = pytest.mark.skipif(not PHOTOGRAPHS.is_dir(), reason=f"the real images are not here: {PHOTOGRAPHS}")

# The lens's image distance is only nominal.
SENSOR = """
channel = "red"
lamp_channel = "grey"
medium = "air"
[stage]
free = true
[sensor]
base = "thesis"
name = "ciclop"
camera = { width_px = 960, height_px = 1280, pixel_size_um = 3.0, focal_length_mm = 4.3, stripe_along = "height", \
window = { mounted = false } }
"""


def imported(tmp_path: Path, folder: str, told: str, *, tables: str = "") -> Capture:
    description = tmp_path / "told.toml"
    description.write_text(told + SENSOR + tables)
    import_images(PHOTOGRAPHS / folder, tmp_path / "real.h5", description=description)
    return Capture(tmp_path / "real.h5")


def test_the_chessboard_gives_the_authors_camera(tmp_path: Path):
    target = '[target]\nkind = "chessboard"\ncolumns = 11\nrows = 6\nsquare_mm = 13.0\n'
    with imported(tmp_path, "chessboard", 'lamp = "frame*.jpg"', tables=target) as capture:
        found = air_evidence([capture])
    assert len(found.images) == 16
    camera = solve_camera(
        found.images,
        width_px=960,
        height_px=1280,
        poses="free",
        options=CameraOptions(square_pixels=False, distortion=("k1", "k2", "p1", "p2", "k3")),
    )
    # The author's figures, all five coefficients estimated: 1430.39 and 1429.67 px for the image's sides, 0.0272 and
    # -0.231. The least-squares problem has one answer: agreement is to a tenth of its standard deviations, which leaves
    # room for other corner windows. Corners in sharp photographs scatter by less than 0.3 px.
    std, model = camera.std(), camera.model
    assert model.fy_px == pytest.approx(1430.39, abs=0.1 * std["fy"])
    assert model.fx_px == pytest.approx(1429.67, abs=0.1 * std["fx"])
    assert model.distortion.k1 == pytest.approx(0.0272, abs=0.1 * std["k1"])
    assert model.distortion.k2 == pytest.approx(-0.231, abs=0.1 * std["k2"])
    assert camera.rms_px() < 0.3


def test_the_stripe_runs_over_the_bust(tmp_path: Path):
    told = 'laser = "laser.png"\nbackground = "laser_background.png"\n'
    with imported(tmp_path, "bust", told) as capture:
        image, saturation = capture.image(0), capture.header.saturation_dn
    stripe = extract_stripe(image, stripe_along="height", saturation=saturation)
    lit, dark = (
        cv2.imread(str(PHOTOGRAPHS / "bust" / name))[:, :, 2] for name in ("laser.png", "laser_background.png")
    )
    # By eye the line reaches from row 54 to 1118, hidden behind the chin and the collar.
    good = stripe.lines[(stripe.lines >= 54) & (stripe.lines <= 1118)]
    assert len(good) > 0.9 * (1118 - 54)
    # The brightest spot of the smoothed difference is within the line, which is up to 10 px wide.
    brightest = cv2.GaussianBlur(lit.astype(np.float32) - dark, (0, 0), 3).argmax(axis=1)
    away = np.abs(stripe.centre_px[good] - brightest[good])
    assert np.mean(away < 5) > 0.98


@pytest.mark.parametrize(("peak", "column"), [(PeakRule.FIRST, 275), (PeakRule.LAST, 590)])
def test_either_of_two_lines_on_the_board_is_straight(tmp_path: Path, peak: PeakRule, column: float):
    told = 'laser = "laser-0*.png"\nbackground = "laser-background*.png"\n'
    with imported(tmp_path, "board", told) as capture:
        image, saturation = capture.image(0), capture.header.saturation_dn
    stripe = extract_stripe(image, stripe_along="height", options=StripeOptions(peak=peak), saturation=saturation)
    # The board fills the rows from 465 to 1000.
    on_board = stripe.lines[(stripe.lines > 465) & (stripe.lines < 1000)]
    assert len(on_board) > 0.95 * 535
    points = np.column_stack([on_board, stripe.centre_px[on_board]])
    points = points[np.abs(points[:, 1] - column) < 20]
    assert len(points) > 0.97 * len(on_board)
    along, across, row, middle = cv2.fitLine(points.astype(np.float32), cv2.DIST_HUBER, 0, 0.01, 0.001).ravel()
    straight = np.abs(points[:, 1] - middle - (points[:, 0] - row) * across / along)
    # The camera's own processing left few grey levels, in steps; a line 4 px wide lies to a fraction of that all the
    # same: half a pixel at the median, 1.5 px but for one row in twenty.
    assert np.median(straight) < 0.5
    assert np.mean(straight < 1.5) > 0.95


@pytest.mark.parametrize(
    ("number", "points", "columns_rows", "residual_px"),
    # 02 was printed in whole dots of the printer, which moves rows and columns by half a pixel.
    [("01", 6400, {98, 69}, 0.05), ("02", 1300, {41, 35}, 0.8), ("05", 4300, {85, 52}, 0.05)],
)
def test_dots_under_strong_distortion_are_numbered(number, points, columns_rows, residual_px):
    image = cv2.imread(str(PHOTOGRAPHS.parent / "dot-patterns" / f"dot_pattern_{number}.jpg"), cv2.IMREAD_GRAYSCALE)
    found = detect_lattice(image)
    assert len(found.indices) > points and set((np.ptp(found.indices, axis=0) + 1).tolist()) == columns_rows
    # A wrong number is a whole spacing off a smooth map of the numbers to the image, that is 25 px and more.
    steps = found.indices - found.indices.mean(axis=0)
    x, y = (2 * steps / np.ptp(steps, axis=0).max()).T
    terms = np.column_stack([x**i * y**j for i in range(10) for j in range(10 - i)])
    centres = found.circles.centres
    away = np.linalg.norm(centres - terms @ np.linalg.lstsq(terms, centres, rcond=None)[0], axis=1)
    assert np.sqrt(np.mean(away**2)) < residual_px and away.max() < 2
