"""Photographs of a chessboard and of a ChArUco board in free poses, the laser drawn on the lit board: imported and
calibrated. The photographs are drawn here with NumPy and OpenCV's warping, not with the sensor's software."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import tomli_w

from tests.uwlts.calibration_views import turn
from tests.uwlts.drawn_stripes import coarse_sensor
from uwlts.calibration.camera.camera_parameters import CameraOptions
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions, calibrate_sequentially
from uwlts.model.placement import camera_from_object, laser_pose
from uwlts.storage.capture import Capture
from uwlts.storage.import_.folder import import_images
from uwlts.targets import CharucoTarget, ChessboardTarget

SENSOR = coarse_sensor(window_mounted=False)
SIZE = SENSOR.camera.width_px, SENSOR.camera.height_px
F, CENTRE = SENSOR.camera.focal_length_px(), np.array(SENSOR.camera.principal_point())
FINER, PX_PER_MM = 4, 12
BLACK, WHITE, LASER, SIGMA_PX, NOISE = 20.0, 120.0, 110.0, 1.5, 1.0
CHESSBOARD = ChessboardTarget(columns=9, rows=6, square_mm=15.0)
CHARUCO = CharucoTarget(columns=10, rows=7, square_mm=15.0, marker_mm=11.0)


def printed(target) -> tuple[np.ndarray, np.ndarray]:
    """Reflectance (h, w) from 0 to 1 of the board with a white rim, and where its first pixel's corner is, mm."""
    if isinstance(target, CharucoTarget):
        size = PX_PER_MM * 15 * np.array([target.columns, target.rows])
        board = target.board().generateImage(tuple(size.tolist())) / 255.0
        corner = np.zeros(2)
    else:
        dark = np.add.outer(np.arange(target.rows + 1), np.arange(target.columns + 1)) % 2
        board = np.kron(dark, np.ones((15 * PX_PER_MM, 15 * PX_PER_MM)))
        corner = np.full(2, -15.0)
    rim = 10 * PX_PER_MM
    return np.pad(board, rim, constant_values=1.0).astype(np.float32), corner - 10.0


def poses(target) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return rotations and translations of the board in the camera frame, near the crossing of sheet and axis."""
    extent = 15.0 * np.array([target.columns, target.rows])
    middle = np.r_[(extent / 2 if isinstance(target, CharucoTarget) else (extent - 15.0) / 2), 0.0]
    at = camera_from_object(SENSOR)[:3, 3]
    found = []
    for x, y, z, depth in (
        (0.35, 0.0, 0.0, 10),
        (-0.35, 0.1, 0.1, -20),
        (0.0, 0.4, -0.1, 30),
        (0.1, -0.4, 0.2, -35),
        (0.3, 0.3, 0.0, 45),
        (-0.25, -0.3, -0.2, 0),
        (0.2, -0.25, 3.0, -10),
        (-0.3, 0.25, 0.3, 20),
    ):
        rotation = turn(x, y, z)
        found.append((rotation, at + [0, 0.15 * depth, depth] - rotation @ middle))
    return found


def photographs(target, rotation, translation, rng) -> tuple[np.ndarray, np.ndarray]:
    """The board in lamp light, without and with the laser on it: each (H, W) uint8."""
    board, corner = printed(target)
    # From the board's pixels to mm, to the camera, to pixels FINER times as fine, with the first centre at 1/2.
    to_mm = np.array([[1 / PX_PER_MM, 0, corner[0] + 0.5 / PX_PER_MM], [0, 1 / PX_PER_MM, corner[1] + 0.5 / PX_PER_MM]])
    to_camera = np.column_stack([rotation[:, :2], translation]) @ np.vstack([to_mm, [0, 0, 1]])
    shift = (FINER - 1) / 2
    lens = np.array([[FINER * F, 0, FINER * CENTRE[0] + shift], [0, FINER * F, FINER * CENTRE[1] + shift], [0, 0, 1]])
    fine = cv2.warpPerspective(board, lens @ to_camera, (FINER * SIZE[0], FINER * SIZE[1]), borderValue=0.3)
    reflectance = cv2.resize(fine, SIZE, interpolation=cv2.INTER_AREA)
    lit = BLACK + (WHITE - BLACK) * reflectance
    normal, laser = rotation[:, 2], laser_pose(SENSOR)
    # The line that board and sheet share, as an image line a u + b v + c = 0.
    along = np.cross(normal, laser.normal)
    point = np.linalg.solve([normal, laser.normal, along], [normal @ translation, laser.normal @ laser.origin_mm, 0.0])
    ends = [point + side * 40 * along / np.linalg.norm(along) for side in (-1, 1)]
    (u0, v0), (u1, v1) = (F * end[:2] / end[2] + CENTRE for end in ends)
    rows = v0 + (np.arange(SIZE[0]) - u0) * (v1 - v0) / (u1 - u0)
    across = np.arange(SIZE[1])[:, None] - rows
    stripe = LASER * (0.3 + 0.7 * reflectance) * np.exp(-((across / SIGMA_PX) ** 2) / 2)
    noisy = (image + rng.normal(0, NOISE, reflectance.shape) for image in (lit, lit + stripe))
    return tuple(np.clip(np.rint(image), 0, 255).astype(np.uint8) for image in noisy)


@pytest.mark.parametrize("target", [CHESSBOARD, CHARUCO], ids=["chessboard", "charuco"])
def test_a_board_in_free_poses_calibrates_camera_and_sheet(tmp_path: Path, target):
    folder, rng = tmp_path / "photographs", np.random.default_rng(6)
    folder.mkdir()
    for number, pose in enumerate(poses(target), start=8):
        plain, lasered = photographs(target, *pose, rng)
        cv2.imwrite(str(folder / f"board{number}.png"), plain)
        cv2.imwrite(str(folder / f"board{number}_laser.png"), lasered)
    plain = ["board?.png", "board??.png"]
    told = {
        "sensor": SENSOR.model_dump(mode="json", exclude_none=True),
        "medium": "air",
        "laser": "*_laser.png",
        "lamp": plain,
        "background": plain,
        "stage": {"free": True},
        "target": target.model_dump(exclude_none=True),
    }
    (folder / "import.toml").write_text(tomli_w.dumps(told))
    imported = import_images(folder, tmp_path / "board.h5")
    assert (imported.laser, imported.lamp, imported.warnings) == (8, 8, ())
    with Capture(tmp_path / "board.h5") as capture:
        options = CalibrationOptions(poses="free", camera=CameraOptions(distortion=()))
        result = calibrate_sequentially([capture], options=options)
    assert result.warnings == [] and len(result.air.images) == 8
    # Four standard deviations of what the corners determine. The sheet hangs on the camera: a wrong focal length scales
    # its distance, a wrong principal point turns it.
    std, model, sheet, laser = (
        result.camera.std(),
        result.calibration.camera,
        result.calibration.sheet,
        laser_pose(SENSOR),
    )
    assert std["f"] < 1e-3 * F
    assert model.fx_px == model.fy_px == pytest.approx(F, abs=4 * std["f"])
    assert (model.cx_px, model.cy_px) == (
        pytest.approx(CENTRE[0], abs=4 * std["cx"]),
        pytest.approx(CENTRE[1], abs=4 * std["cy"]),
    )
    turned = np.arccos(np.clip(np.array(sheet.normal) @ laser.normal, -1, 1))
    assert turned < 4 * (np.hypot(std["cx"], std["cy"]) / F + result.sheet.normal_std_rad)
    assert sheet.offset_mm == pytest.approx(laser.normal @ laser.origin_mm, rel=4 * std["f"] / F)
    assert len(result.stripe_points.points_mm) > 8 * 200
