"""Import, target detection and stripe extraction on real images of others (tests/data/README.md)."""

import re
from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import uwlts
from uwlts.calibration.calibrate import solve_jointly
from uwlts.calibration.camera.camera_parameters import CameraOptions
from uwlts.calibration.camera.lens import LensChoice
from uwlts.calibration.camera.target_poses import solve_camera
from uwlts.calibration.capture_evidence import AirEvidence, find_air_evidence
from uwlts.calibration.joint.gathering import gather_jointly
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions, gather, solve
from uwlts.calibration.target_stripes import stripe_on_target
from uwlts.errors import CaptureError
from uwlts.model.calibration import Calibration
from uwlts.model.mount import PlaneFound
from uwlts.model.parameter_keys import LensParameter
from uwlts.reconstruction.point_uncertainty import estimate_stripe_noise_px, measure_correlation
from uwlts.reconstruction.reconstruct import reconstruct_stripes
from uwlts.storage.capture import Capture
from uwlts.storage.import_.folder import import_images
from uwlts.storage.pose_files import read_poses
from uwlts.stripe import PeakRule, StripeOptions, extract_stripe, find_stripes
from uwlts.targets import ChessboardTarget
from uwlts.targets.detection import detect_lattice

DATA = Path(__file__).resolve().parents[1] / "data"
CICLOP_SIZE = (1280, 960)

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
LASER_AND_BACKGROUND = 'laser = "laser.png"\nbackground = "laser-background.png"' + SENSOR


def whole(cut_out: Path) -> np.ndarray:
    """The cut-out at its place in an image of the Ciclop's full size, its rim continued outwards."""
    x, y = map(int, re.search(r"_x(\d+)_y(\d+)", cut_out.name).groups())
    image = cv2.imread(str(cut_out))
    height, width = image.shape[:2]
    below, right = CICLOP_SIZE[0] - y - height, CICLOP_SIZE[1] - x - width
    return cv2.copyMakeBorder(image, y, below, x, right, cv2.BORDER_REPLICATE)


def imported(tmp_path: Path, folder: str, description: str) -> Capture:
    images = tmp_path / folder
    images.mkdir()
    for cut_out in sorted((DATA / "ciclop" / folder).iterdir()):
        cv2.imwrite(str(images / f"{cut_out.name.split('_')[0]}.png"), whole(cut_out))
    (tmp_path / "import.toml").write_text(description)
    import_images(images, tmp_path / "real.h5", description=tmp_path / "import.toml")
    return Capture(tmp_path / "real.h5")


@pytest.mark.slow
def test_the_chessboard_gives_the_authors_camera(tmp_path: Path):
    target = '[target]\nkind = "chessboard"\ncolumns = 11\nrows = 6\nsquare_mm = 13.0\n'
    with imported(tmp_path, "chessboard", 'lamp = "frame*.png"' + SENSOR + target) as capture:
        found = find_air_evidence([capture])
    assert len(found.images) == 16
    camera = solve_camera(
        found.images,
        width_px=960,
        height_px=1280,
        poses="free",
        options=CameraOptions(pixel_aspect=None, distortion=("k1", "k2", "p1", "p2", "k3")),
    )
    # The author's figures, all five coefficients estimated: 1430.39 and 1429.67 px for the image's sides, 0.0272 and
    # -0.231. From the same images, by other corners: agreement is to about a standard deviation (of k2, the worst).
    # Corners in sharp photographs scatter by less than 0.3 px.
    std, model = camera.std(), camera.model
    assert model.fy_px == pytest.approx(1430.39, abs=2 * std["fy"])
    assert model.fx_px == pytest.approx(1429.67, abs=2 * std["fx"])
    assert model.distortion.k1 == pytest.approx(0.0272, abs=2 * std["k1"])
    assert model.distortion.k2 == pytest.approx(-0.231, abs=2 * std["k2"])
    assert camera.rms_px() < 0.3


def test_the_stripe_runs_over_the_bust(tmp_path: Path):
    with imported(tmp_path, "bust", LASER_AND_BACKGROUND) as capture:
        image, saturation = capture.image(0), capture.header.saturation_dn
    stripe = extract_stripe(image, stripe_along="height", saturation=saturation)
    lit, dark = (
        whole(DATA / "ciclop" / "bust" / f"{name}_x400_y0.png")[:, :, 2] for name in ("laser", "laser-background")
    )
    # By eye the line reaches from row 54 to 1118, hidden behind the chin and the collar.
    good = stripe.lines[(stripe.lines >= 54) & (stripe.lines <= 1118)]
    assert len(good) > 0.9 * (1118 - 54)
    # The brightest spot of the smoothed difference is within the line, which is up to 10 px wide.
    brightest = cv2.GaussianBlur(lit.astype(np.float32) - dark, (0, 0), 3).argmax(axis=1)
    away = np.abs(stripe.centre_px[good] - brightest[good])
    assert np.mean(away < 5) > 0.98


def test_a_cloud_warns_of_a_camera_that_smooths_its_images(tmp_path: Path, etna: Capture):
    """Its noise, the difference of two images beside the stripe, is correlated by 0.84 from line to line."""
    with imported(tmp_path, "bust", LASER_AND_BACKGROUND) as capture:
        cloud = uwlts.reconstruct(capture, uwlts.nominal(capture.header.sensor, medium="air"))
    lit, dark = (
        cv2.imread(str(DATA / "ciclop" / "bust" / f"{name}_x400_y0.png"))[:, :60, 2].astype(float)
        for name in ("laser", "laser-background")
    )
    noise = (lit - dark) - np.mean(lit - dark)
    assert np.mean(noise[1:] * noise[:-1]) > 0.7 * np.mean(noise**2)
    assert any("smooths or compresses" in said for said in cloud.warnings)
    stripes = find_stripes(etna)
    noise = estimate_stripe_noise_px(stripes.frame, stripes.line, stripes.centre_px)
    assert measure_correlation(stripes.frame, stripes.line, stripes.centre_px) < 2
    # The scatter about parabolas, without its largest tenth at the board's edges.
    scatter = []
    for frame in np.unique(stripes.frame):
        own = np.flatnonzero(stripes.frame == frame)
        for run in np.split(own, np.arange(64, len(own), 64))[:-1]:
            line, centre = stripes.line[run], stripes.centre_px[run]
            away = centre - np.polynomial.Polynomial.fit(line, centre, 2)(line)
            scatter.append(np.std(away) / noise[run[0]])
    assert len(scatter) > 150 and 0.5 < np.median(scatter) < 1.5


@pytest.mark.parametrize(("peak", "column"), [(PeakRule.FIRST, 275), (PeakRule.LAST, 590)])
def test_either_of_two_lines_on_the_board_is_straight(tmp_path: Path, peak: PeakRule, column: float):
    with imported(tmp_path, "board", LASER_AND_BACKGROUND) as capture:
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
    # The camera's processing left few grey levels. A line 4 px wide is nevertheless found to a fraction of its width:
    # half a pixel at the median, and 1.5 px in all but one of twenty rows.
    assert np.median(straight) < 0.5
    assert np.mean(straight < 1.5) > 0.95


@pytest.mark.parametrize(
    ("number", "points", "columns_rows", "residual_px"),
    # In 01, two hundred dots of the outer rows are at the edge of the light, which moves them by 0.1 px: left out. 02
    # was printed in whole dots of the printer, which moves rows and columns by half a pixel.
    [("01", 6200, {98, 67}, 0.05), ("02", 1300, {41, 35}, 0.8), ("05", 4300, {85, 52}, 0.05)],
)
def test_dots_under_strong_distortion_are_numbered(number, points, columns_rows, residual_px):
    image = cv2.imread(str(DATA / "dot-patterns" / f"dot_pattern_{number}.jpg"), cv2.IMREAD_GRAYSCALE)
    found = detect_lattice(image)
    assert len(found.indices) > points and set((np.ptp(found.indices, axis=0) + 1).tolist()) == columns_rows
    # A wrong number is a whole spacing off a smooth map of the numbers to the image, that is 25 px and more.
    steps = found.indices - found.indices.mean(axis=0)
    x, y = (2 * steps / np.ptp(steps, axis=0).max()).T
    terms = np.column_stack([x**i * y**j for i in range(10) for j in range(10 - i)])
    centres = found.circles.centres
    away = np.linalg.norm(centres - terms @ np.linalg.lstsq(terms, centres, rcond=None)[0], axis=1)
    assert np.sqrt(np.mean(away**2)) < residual_px and away.max() < 2


@pytest.mark.parametrize("frame", ["frame0014", "frame0016"])
def test_a_board_beside_a_saturated_stripe_is_found(frame: str):
    image = cv2.imread(str(DATA / "etna" / f"{frame}.jpg"), cv2.IMREAD_GRAYSCALE)
    view = ChessboardTarget(columns=7, rows=6, square_mm=10.0).detect(image)
    assert len(view.pixels) == 42
    # Lens distortion changes the homography of a flat board by less than half a pixel. A false corner is a large part
    # of a square (80 to 110 px) away.
    flat = cv2.findHomography(view.points_mm[:, :2], view.pixels)[0]
    away = cv2.perspectiveTransform(view.points_mm[:, None, :2], flat)[:, 0] - view.pixels
    assert np.sqrt(np.mean(away**2)) < 1.0 and np.linalg.norm(away, axis=1).max() < 3.0


@pytest.mark.parametrize("frame", ["frame0014", "frame0016"])
def test_a_wide_saturated_stripe_is_found_along_its_whole_length(frame: str):
    image = cv2.imread(str(DATA / "etna" / f"{frame}.jpg"), cv2.IMREAD_GRAYSCALE)
    board = ChessboardTarget(columns=7, rows=6, square_mm=10.0, margin_mm=60.0)
    stripe = stripe_on_target(image, board.detect(image), board, stripe_along="height", saturation=255.0)
    # By eye the line crosses the plate on every row.
    across, rows = stripe.pixels.T
    assert len(rows) > 0.95 * len(image) and len(set(rows)) == len(rows)
    # It scatters about a smooth curve, of more bends than lens and plate have, no more than by simple methods: the
    # middle of the pixels above a level, and their centre of mass.
    scatter = _scatter(rows, across)
    for level in (128, 200):
        lit = [
            np.flatnonzero(image[int(row)] * (np.abs(np.arange(1280) - x) < 40) >= level) for x, row in stripe.pixels
        ]
        middle = np.array([0.5 * (pixels[0] + pixels[-1]) for pixels in lit])
        mass = np.array([np.average(x, weights=image[int(row), x]) for row, x in zip(rows, lit, strict=True)])
        assert scatter < 1.1 * min(_scatter(rows, middle), _scatter(rows, mass))


ETNA_OPTIONS = CalibrationOptions(poses="free", lens=LensChoice())


@pytest.fixture
def etna(tmp_path: Path) -> Iterator[Capture]:
    """The photographs as a capture: board and stripe in one image."""
    import_images(DATA / "etna", tmp_path / "etna.h5", description=DATA / "etna.toml")
    with Capture(tmp_path / "etna.h5") as capture:
        yield capture


def test_no_reflection_on_the_machine_beside_the_board_is_taken(etna: Capture):
    """They stand 200 px and more beside the line, which itself is too wide to be measured on some lines."""
    stripes, count = find_stripes(etna), 0
    for frame in np.unique(stripes.frame):
        here = stripes[stripes.frame == frame]
        curve = np.polynomial.Chebyshev.fit(here.line, here.centre_px, 3)
        kept = np.abs(here.centre_px - curve(here.line)) < 30
        curve = np.polynomial.Chebyshev.fit(here.line[kept], here.centre_px[kept], 3)
        # The line jumps by 20 px where it leaves the board.
        assert np.abs(here.centre_px - curve(here.line)).max() < 40
        count += len(here.line)
    # By eye the line crosses all 1024 rows of each image.
    assert count > 0.9 * 1024 * len(np.unique(stripes.frame))


def test_radiometry_refuses_photographs_of_a_target_by_hand(etna: Capture):
    known = uwlts.nominal(etna.header.sensor, medium="air")
    with pytest.raises(CaptureError, match="give a scan by a stage"):
        uwlts.fit_radiometry(etna, known)


@pytest.mark.slow
def test_a_folder_of_photographs_calibrates_camera_and_sheet(etna: Capture):
    """Poses free. Halves that agree: tutorial photographs-to-sensor in test_documented_commands.py."""
    evidence = gather([etna], [], options=ETNA_OPTIONS)
    air = evidence.air
    assert len(air.images) == 16 and min(map(len, air.stripes)) > 700
    whole = solve(evidence, options=ETNA_OPTIONS)
    # The robot's poses, which no calibration has seen, agree best with 2350 to 2380 px.
    assert whole.camera.model.fx_px == pytest.approx(2365, abs=2.5 * whole.camera.std()["f"])
    assert 0.005 < np.degrees(whole.sheet.normal_std_rad) < 2.0
    _mount_agrees_with_the_board(etna, whole.calibration, air)


def _mount_agrees_with_the_board(capture: Capture, calibration: Calibration, air: AirEvidence):
    """The stripes on the plate, and nothing else, place the sensor on the robot where the board's corners place it."""
    poses = read_poses(DATA / "etna" / "poses.csv", pose_format="quaternion-xyzw", unit="m")[0]
    cloud = reconstruct_stripes(capture, find_stripes(capture), calibration)
    # Without a stage its positions count the poses.
    seen = cloud.points_mm - np.outer(capture.stage_mm[cloud.frame], capture.header.stage_direction)
    mount = uwlts.calibrate_mount(
        [seen[cloud.frame == n] for n in np.unique(cloud.frame)], poses, artefact_kind="plane"
    )
    assert all(pose.reason is None for pose in mount.poses)
    # The plate is bent by some tenths of a millimetre and stands on a level table.
    assert mount.rms_mm < 0.5 and mount.held_out_rms_mm < 0.8
    assert isinstance(mount.artefact, PlaneFound) and abs(mount.artefact.normal[2]) > np.cos(np.radians(3))

    expected = _by_corners(poses, calibration, air) @ calibration.object_transform()
    apart = np.linalg.norm(expected[:3, 3] - mount.transform()[:3, 3])
    turn = Rotation.from_matrix(expected[:3, :3] @ mount.transform()[:3, :3].T).magnitude()
    # Both take the camera as exact, whose focal length has a standard uncertainty of 1.5 %: twice that are 6 mm of the
    # distance to the plate.
    assert apart < 6.0 and np.degrees(turn) < 4.0


def _by_corners(poses: np.ndarray, calibration: Calibration, air: AirEvidence) -> np.ndarray:
    """``T_tool_camera`` (4, 4) by Park and Martin 1994 from the board's poses (OpenCV)."""
    camera, seen = calibration.camera, []
    matrix = np.array([[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1]])
    for view in air.images:
        _, turn, shift = cv2.solvePnP(view.points_mm, view.pixels, matrix, None)
        seen.append(np.vstack([np.column_stack([cv2.Rodrigues(turn)[0], shift]), [0, 0, 0, 1]]))
    pairs = list(combinations(range(len(poses)), 2))
    tools = np.array([np.linalg.inv(poses[i]) @ poses[k] for i, k in pairs])
    boards = np.array([seen[i] @ np.linalg.inv(seen[k]) for i, k in pairs])
    by_tool, by_board = (Rotation.from_matrix(each[:, :3, :3]).as_rotvec() for each in (tools, boards))
    result = np.eye(4)
    result[:3, :3] = Rotation.align_vectors(by_tool, by_board)[0].as_matrix()
    known = boards[:, :3, 3] @ result[:3, :3].T - tools[:, :3, 3]
    result[:3, 3] = np.linalg.lstsq((tools[:, :3, :3] - np.eye(3)).reshape(-1, 3), known.ravel(), rcond=None)[0]
    return result


@pytest.mark.slow
def test_photographs_that_do_not_fit_the_model_are_calibrated_jointly_all_the_same(etna: Capture):
    """The plate is bent: what the images share is stated, and half of them agrees with the robot's poses."""
    evidence = gather_jointly([etna], [], options=ETNA_OPTIONS)
    (series,) = evidence.series
    found = series.found.only(np.arange(0, 16, 2), series.found.images[::2])
    result = solve_jointly(replace(evidence, series=[replace(series, found=found)]), options=ETNA_OPTIONS)
    assert any("deviations from the model: all points of an image count as one" in said for said in result.warnings)
    every = result.estimate.std()
    std = every[LensParameter.FX if LensParameter.FX in every else LensParameter.F]
    assert 10 < std < 150
    assert result.calibration.camera.fx_px == pytest.approx(2365, abs=2.5 * std)


@pytest.mark.slow
def test_a_camera_that_is_known_is_held(tmp_path: Path):
    """The camera of the same photographs without the laser: the joint calibration keeps it, and finds the sheet."""
    matrix = "camera_matrix: {rows: 3, cols: 3, data: [2438.08, 0, 620.37, 0, 2438.08, 518.72, 0, 0, 1]}"
    lens = "distortion_coefficients: {rows: 1, cols: 4, data: [0, 0, 4.6e-4, 1.04e-3]}"
    (tmp_path / "camera.yaml").write_text(f"%YAML:1.0\n---\n{matrix}\n{lens}\n")
    text = (
        (DATA / "etna.toml").read_text().replace('name = "etna"', 'name = "etna"\nuncertainty = { focal_length = 0 }')
    )
    (tmp_path / "held.toml").write_text('intrinsics = "camera.yaml"\n' + text)
    import_images(DATA / "etna", tmp_path / "held.h5", description=tmp_path / "held.toml")
    held = uwlts.calibrate(air=[tmp_path / "held.h5"], target_poses="free")
    assert held.joint is not None and held.joint.std[0] < 0.3
    assert held.camera.fx_px == pytest.approx(2438.08, abs=0.3) and held.camera.cx_px == pytest.approx(620.37, abs=0.3)
    # The sequential calibration finds this normal, known to 0.66 deg.
    normal = np.array([0.840202, 0.120414, -0.528736])
    assert np.degrees(np.arccos(held.sheet.normal @ normal)) < 2.0


def _scatter(rows: np.ndarray, across: np.ndarray) -> float:
    away = across - np.polynomial.Polynomial.fit(rows, across, 8)(rows)
    return float(np.sqrt(np.mean(away**2)))
