"""Laser sheet from stripes on the target: exact recovery, correct scatter, outliers, extent of the plate, refusals."""

import numpy as np
import pytest

from tests.uwlts.calibration_views import built_sensor, lattice, lens_of, stage_images, stripes_on_target, turn
from uwlts.calibration.camera.target_poses import refuse_turned_travel
from uwlts.calibration.sequential.sheet_fit import fit_sheet, object_frame, points_on_target
from uwlts.errors import CalibrationError, RangeError
from uwlts.model.calibration import CameraModel, SheetModel
from uwlts.model.placement import camera_from_object, laser_pose
from uwlts.model.sensor import Distortion
from uwlts.targets import parse_target
from uwlts.targets.target import rectangle_corners

SENSOR = built_sensor()
LENS = lens_of(SENSOR)
LASER = laser_pose(SENSOR)
OFFSET = float(LASER.normal @ LASER.origin_mm)
CAMERA = CameraModel(
    width_px=1280,
    height_px=1024,
    fx_px=LENS.fx,
    fy_px=LENS.fy,
    cx_px=LENS.cx,
    cy_px=LENS.cy,
    distortion=Distortion(k1=LENS.k1, k2=LENS.k2),
)
EXTENT = lattice()[:, :2]
POSITIONS = np.arange(11) * 25.0


def stripe_points(*, positions=POSITIONS, noise_px=0.0, rng=None, margin_mm=4.7, extent=EXTENT):
    _, poses, _ = stage_images(SENSOR, positions=positions)
    stripes = stripes_on_target(SENSOR, poses, noise_px=noise_px, rng=rng)
    plate = rectangle_corners(extent.min(axis=0) - margin_mm, extent.max(axis=0) + margin_mm)
    return points_on_target(CAMERA, stripes, poses, plate_mm=plate)


def angle(first, second):
    return np.arcsin(np.linalg.norm(np.cross(first, second)))


def test_exact_stripes_give_the_exact_sheet():
    points = stripe_points()
    assert len(points.points_mm) > 5000
    assert len(np.unique(points.image)) > 8
    solution = fit_sheet(points.points_mm, nominal_normal=LASER.normal)
    # Coordinates of 500 mm carry rounding of 1e-13 mm; the inverse of the lens is as exact.
    assert angle(np.array(solution.model.normal), LASER.normal) < 1e-12
    assert solution.model.offset_mm == pytest.approx(OFFSET, abs=1e-9)
    assert (solution.rms_mm, solution.rejected_share) == (pytest.approx(0, abs=1e-9), 0)
    frame = object_frame(solution.model, laser_axis=LASER.axis)
    np.testing.assert_allclose(frame, camera_from_object(SENSOR), atol=1e-8)


def test_the_normal_turns_to_the_nominal_side():
    points = stripe_points().points_mm
    nominal = -LASER.normal + 0.02
    solution = fit_sheet(points, nominal_normal=nominal / np.linalg.norm(nominal))
    assert np.array(solution.model.normal) @ LASER.normal == pytest.approx(-1)
    assert solution.model.offset_mm == pytest.approx(-OFFSET, abs=1e-9)
    assert solution.turn_rad == pytest.approx(angle(nominal / np.linalg.norm(nominal), LASER.normal), rel=1e-6)


def test_the_normals_scatter_is_the_reported_one():
    rng, angles, reported = np.random.default_rng(1), [], []
    for _ in range(40):
        solution = fit_sheet(stripe_points(noise_px=0.15, rng=rng).points_mm, nominal_normal=LASER.normal)
        angles.append(angle(np.array(solution.model.normal), LASER.normal))
        reported.append(solution.normal_std_rad)
    # The largest of the two components' deviations is reported; the noise in mm grows with distance, so the plain
    # fit's figure is good to some 20 %, and 40 draws of two components to 11 %: 4 std in all.
    rms = np.sqrt(np.mean(np.square(angles)))
    assert 0.6 * np.mean(reported) < rms < 2.0 * np.mean(reported)


def test_outliers_are_left_out_and_counted():
    rng = np.random.default_rng(2)
    points = stripe_points(noise_px=0.15, rng=rng).points_mm
    clean = fit_sheet(points, nominal_normal=LASER.normal)
    stray = rng.choice(len(points), len(points) // 20, replace=False)
    points = points.copy()
    points[stray] += np.outer(rng.uniform(2, 20, len(stray)), LASER.normal)
    solution = fit_sheet(points, nominal_normal=LASER.normal)
    assert not solution.used[stray].any()
    assert solution.rejected_share == pytest.approx(0.05, abs=2e-3)
    # 5 % fewer points move the plane by a small fraction of its standard deviation.
    assert angle(np.array(solution.model.normal), np.array(clean.model.normal)) < clean.normal_std_rad
    assert solution.max_mm < 10 * solution.rms_mm
    assert np.abs(solution.residuals_mm[stray]).min() > solution.max_mm


def test_only_stripes_on_the_plate_count():
    full = stripe_points(margin_mm=10.0)
    half = stripe_points(extent=EXTENT[EXTENT[:, 0] <= 0], margin_mm=0.0)
    wider = stripe_points(extent=EXTENT[EXTENT[:, 0] <= 0], margin_mm=10.0)
    assert 0.3 < len(half.points_mm) / len(full.points_mm) < 0.7
    assert len(half.points_mm) < len(wider.points_mm) < len(full.points_mm)
    _, poses, _ = stage_images(SENSOR, positions=POSITIONS)
    local = np.einsum("nij,ni->nj", poses[half.image, :3, :3], half.points_mm - poses[half.image, :3, 3])
    assert local[:, 0].max() <= 1e-9
    assert local[:, 0].max() > -0.5
    np.testing.assert_allclose(local[:, 2], 0, atol=1e-9)
    with pytest.raises(CalibrationError, match="none of the stripes"):
        stripe_points(extent=EXTENT + 1000.0)


def test_undetermined_sheets_are_refused():
    rng = np.random.default_rng(3)
    for noise in (0.0, 0.15):
        single = stripe_points(positions=np.array([50.0]), noise_px=noise, rng=rng).points_mm
        # Noise moves the points within the target's plane, so all are on this plane.
        with pytest.raises(CalibrationError, match="one line|extend only"):
            fit_sheet(single, nominal_normal=LASER.normal)
    points = stripe_points().points_mm
    with pytest.raises(CalibrationError, match="turned by"):
        fit_sheet(points, nominal_normal=LASER.axis)
    with pytest.raises(CalibrationError, match="not finite"):
        fit_sheet(np.vstack([points, [0.0, np.nan, 400.0]]), nominal_normal=LASER.normal)
    both = np.vstack([points, points[: len(points) // 2] + 15 * LASER.normal])
    with pytest.raises(CalibrationError, match="are not on|extend only"):
        fit_sheet(both, nominal_normal=LASER.normal)


def test_measures_in_other_units_are_noticed():
    normal, rng = np.array([0.6, 0.0, -0.8]), np.random.default_rng(2)
    points = 120.0 * normal + rng.uniform(-50, 50, (200, 2)) @ np.array([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0]])
    for nominal in (100.0, 140.0):
        assert fit_sheet(points, nominal_normal=normal, nominal_offset_mm=nominal).model.offset_mm == pytest.approx(120)
    for factor in (0.1, 10.0):
        with pytest.raises(CalibrationError, match="measures must be in mm"):
            fit_sheet(factor * points, nominal_normal=normal, nominal_offset_mm=120.0)
    with pytest.raises(
        CalibrationError, match="at -120.0 mm; expected 120.0 mm from .* on the other side: the images are"
    ):
        fit_sheet(-points, nominal_normal=normal, nominal_offset_mm=120.0)


MIRRORED = {"left to right": np.array([-1.0, 1.0, 1.0]), "top to bottom": np.array([1.0, -1.0, 1.0])}


@pytest.mark.parametrize("how", MIRRORED)
def test_mirrored_images_show_where_the_laser_stands_beside_the_cameras_axes(how):
    """A symmetric board is the same in a mirror. The laser of the second sensor stands to the lower right."""
    points = stripe_points().points_mm
    given = {"nominal_normal": LASER.normal, "nominal_offset_mm": float(LASER.normal @ LASER.origin_mm)}
    if how == "top to bottom":
        said = "the images are turned by 180 deg or mirrored top to bottom, or the laser is on"
        with pytest.raises(CalibrationError, match=said):
            fit_sheet(points * MIRRORED[how], **given)
    else:
        # The laser stands above the camera: its mirror image is the same to the tenths of a degree of its mounting.
        assert fit_sheet(points * MIRRORED[how], **given).turn_rad < np.radians(2)
    aside = turn(z=np.radians(35.0))
    given["nominal_normal"] = aside @ LASER.normal
    assert fit_sheet(points @ aside.T, **given).turn_rad < np.radians(2)
    with pytest.raises(CalibrationError, match=f"if the images are mirrored {how}, or the laser is on"):
        fit_sheet(points @ aside.T * MIRRORED[how], **given)


def test_a_laser_nearly_along_the_camera_shows_mirrored_images_by_its_side():
    """A sheet 5 deg from the camera's axis is turned by 10 deg in a mirror, within what descriptions are rough by."""
    cosine, sine = np.cos(np.radians(5.0)), np.sin(np.radians(5.0))
    normal, along = np.array([0.0, -cosine, sine]), np.array([0.0, sine, cosine])
    across, reach = np.random.default_rng(2).uniform(-50, 50, (2, 200, 1))
    points = 80.0 * normal + across * np.array([1.0, 0.0, 0.0]) + (400.0 + reach) * along
    given = {"nominal_normal": normal, "nominal_offset_mm": 80.0}
    assert fit_sheet(points, **given).turn_rad < 1e-6
    with pytest.raises(CalibrationError, match="at -80.0 mm; .* on the other side: the images are turned"):
        fit_sheet(points * MIRRORED["top to bottom"], **given)


@pytest.mark.parametrize(
    ("found", "how"),
    [
        ((0.1, 0.6, 0.8), ""),
        ((-0.6, 0.0, 0.8), "turned by 180 deg or mirrored left to right"),
        ((0.0, 0.0, -1.0), ""),
        ((0.3, 0.3, -0.9), ""),
    ],
)
def test_a_stage_that_moves_as_in_a_mirror_is_refused(found, how):
    """Described along (0.6, 0, 0.8); its own error, and one that no mirror explains, is a warning elsewhere."""
    found, described = np.array(found) / np.linalg.norm(found), np.array([1.2, 0.0, 1.6])
    refuse_turned_travel(None, described)
    if not how:
        refuse_turned_travel(found, described)
        return
    with pytest.raises(
        CalibrationError, match=f"along \\[0.6, 0.0, 0.8\\]. This occurs if the images are {how}: correct"
    ):
        refuse_turned_travel(found, described)


def test_pixels_and_poses_must_be_finite():
    _, poses, _ = stage_images(SENSOR, positions=POSITIONS)
    stripes = stripes_on_target(SENSOR, poses)
    with pytest.raises(RangeError, match="finite"):
        points_on_target(CAMERA, [s * np.nan for s in stripes], poses, plate_mm=EXTENT)
    with pytest.raises(CalibrationError, match="pose"):
        points_on_target(CAMERA, stripes, np.full_like(poses, np.nan), plate_mm=EXTENT)


def test_the_object_frame_belongs_to_the_sheet():
    normal = np.array([0.1, -0.8, 0.6])
    normal /= np.linalg.norm(normal)
    sheet = SheetModel(normal=tuple(normal), offset_mm=210.0)
    frame = object_frame(sheet, laser_axis=np.array([0.0, 0.5, 0.9]))
    rotation, origin = frame[:3, :3], frame[:3, 3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(rotation) == pytest.approx(1)
    np.testing.assert_allclose(rotation[:, 0], normal)
    assert rotation[:, 2] @ [0.0, 0.5, 0.9] > 0.9
    assert origin @ normal == pytest.approx(210.0)
    assert tuple(origin[:2]) == (0, 0)
    with pytest.raises(CalibrationError, match="axis is perpendicular"):
        object_frame(sheet, laser_axis=normal)
    with pytest.raises(CalibrationError, match="in front"):
        object_frame(SheetModel(normal=tuple(normal), offset_mm=-210.0), laser_axis=np.array([0.0, 0.5, 0.9]))


def test_the_plates_extent_follows_its_description():
    circles = parse_target(
        {"kind": "circles", "diameter_mm": 6, "marker_diameter_mm": 2, "columns": 5, "rows": 4, "origin": (1, 1)}
    )
    np.testing.assert_allclose(circles.extent_mm[[0, 2]], [[-9.375, -9.372], [28.125, 18.744]])
    assert circles.spacing_mm == 9.372
    board = parse_target({"kind": "chessboard", "columns": 5, "rows": 4, "square_mm": 10})
    np.testing.assert_allclose(board.extent_mm[[0, 2]], [[0, 0], [40, 30]])
    charuco = parse_target({"kind": "charuco", "columns": 5, "rows": 4, "square_mm": 10, "marker_mm": 7})
    np.testing.assert_allclose(charuco.extent_mm[[0, 2]], [[0, 0], [50, 40]])
    assert board.spacing_mm == charuco.spacing_mm == 10
