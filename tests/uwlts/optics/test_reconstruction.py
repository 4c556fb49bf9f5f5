"""Lens, window and sheet together: pixels to points and back, against OpenCV's lens model and Fermat's principle."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from tests.oracles import fermat
from tests.uwlts.drawn_windows import faces_and_indices, indices, seeds, tilted, windows
from uwlts.errors import RangeError
from uwlts.model.calibration import Calibration, CameraModel, SheetModel, WindowModel
from uwlts.model.library import load_sensor
from uwlts.model.sensor import Distortion, Sensor
from uwlts.optics.camera import directions, project, project_through_window
from uwlts.optics.nominal import nominal_calibration
from uwlts.optics.triangulation import points_on_sheet, reconstruct_pixels, reconstruct_profile, to_object
from uwlts.optics.window import RayStatus, trace_window

WATER = 1.3312
FOCAL_PX = 2358.0

brown_conrady = {name: st.floats(-0.5, 0.5) for name in ("k1", "k2", "k3")}
brown_conrady |= {name: st.floats(-0.01, 0.01) for name in ("p1", "p2")}
# The denominator stays above a third up to r = 1.2, the farthest that is asked for: near a pole roundings grow.
rational = brown_conrady | {name: st.floats(-0.1, 0.5) for name in ("k4", "k5", "k6")}
distortions = st.builds(Distortion, **brown_conrady) | st.builds(Distortion, **rational)


def camera(*, distortion: Distortion | None = None, focal_px: float = FOCAL_PX) -> CameraModel:
    return CameraModel(
        width_px=1280,
        height_px=1024,
        fx_px=focal_px,
        fy_px=1.002 * focal_px,
        cx_px=645.3,
        cy_px=507.9,
        distortion=distortion or Distortion(),
    )


def whole_image(count: int = 500, *, seed: int = 0) -> np.ndarray:
    """Pixels (count, 2) all over the image, its four corners among them."""
    corners = [[-0.5, -0.5], [1279.5, -0.5], [-0.5, 1023.5], [1279.5, 1023.5]]
    inside = np.random.default_rng(seed).uniform([-0.5, -0.5], [1279.5, 1023.5], (count - 4, 2))
    return np.concatenate([corners, inside])


def by_opencv(model: CameraModel, points: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) by OpenCV's lens model."""
    pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), model.matrix(), model.coefficients())
    return pixels.reshape(-1, 2)


@settings(deadline=None, max_examples=40)
@given(distortions, seeds)
def test_directions_come_back_to_their_pixels_through_opencv(distortion, seed):
    model, pixels = camera(distortion=distortion), whole_image(seed=seed)
    rays = directions(model, pixels)
    found = np.isfinite(rays).all(axis=1)
    assert found.sum() > 400
    np.testing.assert_allclose(np.linalg.norm(rays[found], axis=1), 1.0, rtol=0, atol=4e-16)
    # The inverse ends within 4e-15 (1 + 0.7) of the distorted position, times 2363 px: 1.6e-11 px, and roundings of
    # 1280 px, 2e-13 px. The promise is 1e-9 px.
    np.testing.assert_allclose(by_opencv(model, rays[found]), pixels[found], rtol=0, atol=1e-9)
    np.testing.assert_allclose(project(model, rays[found]), pixels[found], rtol=0, atol=1e-9)


def test_strong_barrel_distortion_is_inverted_up_to_its_edge_and_flagged_beyond():
    # x (1 - 0.3 x^2) rises up to x = 1.0541, where it is 0.70273: no image is farther out.
    model = camera(distortion=Distortion(k1=-0.3), focal_px=1000.0)
    edge = math.sqrt(1 / 0.9) * (1 - 0.3 / 0.9)
    around = np.linspace(0, 2 * math.pi, 400)
    ring = np.stack([1000.0 * np.cos(around), 1002.0 * np.sin(around)], axis=1)
    centre = [model.cx_px, model.cy_px]
    for share in (0.1, 0.5, 0.9, 0.99, 0.999999):
        pixels = centre + share * edge * ring
        rays = directions(model, pixels)
        assert np.isfinite(rays).all(), share
        assert (np.hypot(rays[:, 0], rays[:, 1]) / rays[:, 2] < math.sqrt(1 / 0.9)).all()
        np.testing.assert_allclose(by_opencv(model, rays), pixels, rtol=0, atol=1e-9)
    for share in (1.000001, 1.1, 1.5, 5.0):
        assert np.isnan(directions(model, centre + share * edge * ring)).all(), share


@settings(deadline=None, max_examples=60)
@given(distortions, seeds)
def test_every_point_the_lens_can_show_is_found_again(distortion, seed):
    model = camera(distortion=distortion)
    random = np.random.default_rng(seed)
    around, radius = random.uniform(0, 2 * math.pi, 300), 1.2 * np.sqrt(random.uniform(size=300))
    points = np.stack([radius * np.cos(around), radius * np.sin(around), np.ones(300)], axis=1)
    pixels = project(model, points)
    shown = np.isfinite(pixels).all(axis=1)
    assert shown.sum() > 30
    np.testing.assert_allclose(pixels[shown], by_opencv(model, points[shown]), rtol=0, atol=1e-9)
    back = directions(model, pixels[shown])
    assert np.isfinite(back).all()
    np.testing.assert_allclose(project(model, back), pixels[shown], rtol=0, atol=1e-9)
    # In space the error of 1e-14 is divided by the slope of the distortion, which vanishes at the edge: near it the
    # square root of 1e-14 is left. A second, wrong solution would be off by much more.
    np.testing.assert_allclose(back / back[:, 2:], points[shown], rtol=0, atol=1e-6)


def test_a_rational_lens_ends_where_it_folds_or_has_a_pole():
    # x / (1 + 0.3 x^2) rises up to x = 1.8257, where it is half of that.
    model, edge = camera(distortion=Distortion(k4=0.3)), math.sqrt(1 / 0.3)
    x = np.array([0.5, 1.0, 1.8, 1.8257]) * [[1], [-1]]
    pixels = project(model, np.column_stack([x.ravel(), 0 * x.ravel(), 0 * x.ravel() + 1]))
    np.testing.assert_allclose(pixels[:, 0], model.cx_px + FOCAL_PX * (x / (1 + 0.3 * x**2)).ravel(), rtol=1e-14)
    assert np.isnan(project(model, np.array([[1.8259, 0.0, 1.0], [3.0, 0.0, 1.0]]))).all()
    outside = model.cx_px + FOCAL_PX * edge / 2 * 1.00001
    assert np.isnan(directions(model, np.array([[outside, model.cy_px]]))).all()
    # x / (1 - 0.5 x^2) grows beyond all bounds up to x = 1.4142 and comes back from the other side.
    model = camera(distortion=Distortion(k4=-0.5))
    assert project(model, np.array([[1.41, 0.0, 1.0]]))[0, 0] > 200 * FOCAL_PX
    assert np.isnan(project(model, np.array([[1.42, 0.0, 1.0]]))).all()


def test_a_fold_of_the_distortion_is_not_shown_as_an_image():
    # At x = 1.2 the polynomial gives 0.68, the image of another point at x = 0.93.
    model = camera(distortion=Distortion(k1=-0.3))
    assert np.isnan(project(model, np.array([[1.2, 0.0, 1.0]]))).all()
    assert np.isnan(project(model, np.array([[0.1, 0.0, 0.0], [0.1, 0.0, -1.0]]))).all()


@settings(deadline=None, max_examples=60)
@given(windows, indices, seeds)
def test_projection_through_the_window_is_the_path_of_least_time(window, medium_index, seed):
    faces, path = faces_and_indices(window, medium_index)
    points = points_beyond(faces[-1], seed=seed, count=40, steepest_deg=60.0)
    seen = fermat.directions_seen(points, faces, path)
    ahead = seen[:, 2] > 0.3
    assert ahead[0] and ahead.sum() > 5
    model = camera()
    pixels = project_through_window(model, window, points, medium_index=medium_index)
    # The oracle's crossings are good to roundings of 1e3 mm, divided by the cosine squared of 60 deg: 1e-12 mm; that at
    # 5 mm or farther, seen with 2363 px at up to 73 deg from the axis (1 / 0.3^2).
    tolerance = 1e-12 / 5.0 / 0.3**2 * 1.002 * FOCAL_PX
    np.testing.assert_allclose(pixels[ahead], by_opencv(model, seen[ahead]), rtol=0, atol=tolerance)


def points_beyond(face: fermat.Face, *, seed: int, count: int, steepest_deg: float) -> np.ndarray:
    """Return points (count, 3) 1 to 500 mm beyond a face, up to an angle from its normal through the pupil.

    The first point is on this normal.
    """
    random = np.random.default_rng(seed)
    height = (face.point @ face.normal + random.uniform(1.0, 500.0, count))[:, None]
    slope = math.tan(math.radians(steepest_deg)) * np.r_[0.0, random.uniform(0, 1, count - 1)][:, None]
    around = random.uniform(0, 2 * math.pi, count)
    across = np.stack([np.cos(around), np.sin(around)], axis=1) @ face.basis().T
    return height * (face.normal + slope * across)


@settings(deadline=None, max_examples=40)
@given(windows, st.floats(0.9, 1.8), seeds)
def test_the_ray_of_a_projected_point_passes_through_it_at_any_angle(window, medium_index, seed):
    face = faces_and_indices(window, medium_index)[0][-1]
    points = points_beyond(face, seed=seed, count=100, steepest_deg=85.0)
    model = camera()
    pixels = project_through_window(model, window, points, medium_index=medium_index)
    shown = np.isfinite(pixels).all(axis=1)
    assert shown[0] and shown.sum() > 40
    rays = trace_window(directions(model, pixels[shown]), window, medium_index=medium_index)
    ok = rays.status == RayStatus.OK
    assert ok.sum() > 40
    missed = np.linalg.norm(np.cross(points[shown][ok] - rays.origins[ok], rays.directions[ok]), axis=1)
    # Near grazing a rounding of 1e-16 of the sine becomes 1e-8 of the angle; the promise holds where the ray in the
    # medium stays 1 deg off the face, a magnification of 1 / sin^2 of it, 3e3, of roundings of 1e4 mm, 2e-12 mm. Where
    # the medium is denser than air, the ray before the window grazes it more: up to ten times that.
    steady = rays.directions[ok] @ face.normal > math.sin(math.radians(1.0))
    assert steady.sum() > 20
    assert missed[steady].max() < 1e-7


@settings(deadline=None, max_examples=40)
@given(windows, st.floats(0.9, 1.8), distortions, seeds)
def test_a_traced_pixel_projects_back_to_its_position(window, medium_index, distortion, seed):
    model, pixels = camera(distortion=distortion), whole_image(200, seed=seed)
    rays = trace_window(directions(model, pixels), window, medium_index=medium_index)
    ok = rays.status == RayStatus.OK
    assert ok.sum() > 150
    depth = np.random.default_rng(seed).uniform(1.0, 1000.0, len(pixels))
    points = rays.origins + depth[:, None] * rays.directions
    again = project_through_window(model, window, points[ok], medium_index=medium_index)
    # Roundings of 1e3 mm (1e-13 mm) seen at 6 mm or farther with 2363 px, and the lens's 2e-11 px. Incidence up to
    # 50 deg on a medium of index 0.9, close to total reflection, magnifies them at most a hundred times.
    np.testing.assert_allclose(again, pixels[ok], rtol=0, atol=1e-8)


def test_without_a_window_the_projection_is_the_cameras():
    points = np.random.default_rng(8).uniform([-100, -80, 200], [100, 80, 400], (50, 3))
    model = camera(distortion=Distortion(k1=-0.1))
    np.testing.assert_array_equal(
        project_through_window(model, None, points, medium_index=WATER), project(model, points)
    )


def test_points_inside_the_housing_or_the_glass_have_no_image_through_the_window():
    window = WindowModel(refractions=2, distance_mm=60.0, thickness_mm=6.0, glass_index=1.52)
    points = np.array([[1.0, 1.0, 67.0], [1.0, 1.0, 66.0], [1.0, 1.0, 63.0], [1.0, 1.0, 30.0], [1.0, 1.0, -30.0]])
    shown = np.isfinite(project_through_window(camera(), window, points, medium_index=WATER)).all(axis=1)
    assert shown.tolist() == [True, False, False, False, False]


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_numbers_that_are_not_finite_are_refused(bad):
    calibration, window = nominal("width"), WindowModel(refractions=1, distance_mm=50.0)
    pixels, points = np.array([[1.0, 2.0], [3.0, bad]]), np.array([[0.0, bad, 300.0]])
    with pytest.raises(RangeError, match="pixels"):
        points_on_sheet(calibration, pixels, medium_index=WATER)
    with pytest.raises(RangeError, match="points"):
        project(camera(), points)
    with pytest.raises(RangeError, match="points"):
        project_through_window(camera(), window, points, medium_index=WATER)
    with pytest.raises(RangeError, match="medium_index"):
        points_on_sheet(calibration, pixels[:1], medium_index=bad)
    with pytest.raises(RangeError, match="medium_index"):
        project_through_window(camera(), window, np.ones((1, 3)), medium_index=bad)
    with pytest.raises(RangeError, match="stage"):
        to_object(calibration, np.ones((1, 3)), stage_mm=bad, stage_direction=(1.0, 0.0, 0.0))


def thesis(stripe_along: str, *, distortion: Distortion | None = None) -> Sensor:
    sensor = load_sensor("thesis")
    changes = {"stripe_along": stripe_along, "distortion": distortion or Distortion()}
    return sensor.model_copy(update={"camera": sensor.camera.model_copy(update=changes)})


def nominal(stripe_along: str, *, distortion: Distortion | None = None) -> Calibration:
    return nominal_calibration(thesis(stripe_along, distortion=distortion))


@pytest.mark.parametrize("stripe_along", ["width", "height"])
@pytest.mark.parametrize("distortion", [Distortion(), Distortion(k1=-0.12, k2=0.15, p1=4e-4, p2=-7e-4)])
@pytest.mark.parametrize("medium_index", [1.0, WATER])
def test_measured_points_lie_on_the_sheet_and_are_seen_at_their_pixels(stripe_along, distortion, medium_index):
    calibration, pixels = nominal(stripe_along, distortion=distortion), whole_image(400)
    found = points_on_sheet(calibration, pixels, medium_index=medium_index)
    ok = found.status == RayStatus.OK
    assert ok.sum() > 300
    points = found.points_mm[ok]
    # Most of the image sees the sheet within 10 m, where roundings are 1e-12 mm; rays nearly along the sheet beyond it.
    near = points[:, 2] < 1e4
    assert near.sum() > 300
    normal = np.array(calibration.sheet.normal)
    np.testing.assert_allclose(points[near] @ normal, calibration.sheet.offset_mm, rtol=0, atol=2e-11)
    outer = calibration.window.distance_mm + calibration.window.thickness_mm
    assert (points[:, 2] > outer).all()
    faces, path = faces_and_indices(calibration.window, medium_index)
    seen = fermat.directions_seen(points[near], faces, path)
    # The lens's 2e-11 px and the oracle's 1e-12 mm at 63 mm or farther, with 2358 px.
    np.testing.assert_allclose(by_opencv(calibration.camera, seen), pixels[ok][near], rtol=0, atol=1e-9)
    again = project_through_window(calibration.camera, calibration.window, points[near], medium_index=medium_index)
    np.testing.assert_allclose(again, pixels[ok][near], rtol=0, atol=1e-9)


def sheet_seen_from_above(offset_mm: float, normal: tuple[float, float, float]) -> Calibration:
    """The thesis's camera and window before another sheet."""
    return nominal("width").model_copy(update={"sheet": SheetModel(normal=normal, offset_mm=offset_mm)})


@pytest.mark.parametrize(
    ("offset_mm", "normal", "expected"),
    [
        (300.0, (0.0, 0.0, 1.0), RayStatus.OK),
        (-300.0, (0.0, 0.0, -1.0), RayStatus.OK),
        (30.0, (0.0, 0.0, 1.0), RayStatus.BEHIND),
        (65.0, (0.0, 0.0, 1.0), RayStatus.BEHIND),
        (-300.0, (0.0, 0.0, 1.0), RayStatus.NO_CROSSING),
        (5.0, (1.0, 0.0, 0.0), RayStatus.NO_CROSSING),
    ],
    ids=["ahead", "ahead, normal reversed", "in the housing", "in the glass", "behind the camera", "parallel"],
)
def test_the_axial_ray_meets_the_sheet_or_says_why_not(offset_mm, normal, expected):
    calibration = sheet_seen_from_above(offset_mm, normal)
    axis = np.array([[calibration.camera.cx_px, calibration.camera.cy_px]])
    found = points_on_sheet(calibration, axis, medium_index=WATER)
    assert found.status.tolist() == [expected]
    assert found.status.dtype == np.uint8
    assert np.isfinite(found.points_mm).all() == (expected == RayStatus.OK)
    if expected == RayStatus.OK:
        np.testing.assert_allclose(found.points_mm, [[0.0, 0.0, 300.0]], rtol=0, atol=1e-12)


def test_failures_of_lens_and_window_keep_their_status_among_good_points():
    calibration = nominal("width", distortion=Distortion(k1=-4.0))
    centre, corner = [639.5, 511.5], [0.0, 0.0]
    # x (1 - 4 x^2) ends at 0.192; the corner is at 0.347.
    found = points_on_sheet(calibration, np.array([centre, corner, centre]), medium_index=WATER)
    assert found.status.tolist() == [RayStatus.OK, RayStatus.NO_DIRECTION, RayStatus.OK]
    assert np.isnan(found.points_mm[1]).all() and np.isfinite(found.points_mm[[0, 2]]).all()

    wide = camera(focal_px=300.0)
    steep = WindowModel(
        refractions=2, distance_mm=60.0, normal=tuple(tilted(0.0, 40.0)), thickness_mm=6, glass_index=1.52
    )
    calibration = nominal("width").model_copy(
        update={"camera": wide, "window": steep, "sheet": SheetModel(normal=steep.normal, offset_mm=500.0)}
    )
    row = np.array([[0.0, 507.9], [645.3, 507.9], [1279.0, 507.9]])  # at -65, 0 and 65 deg, the window's normal at 40
    found = points_on_sheet(calibration, row, medium_index=0.5)
    assert found.status.tolist() == [RayStatus.BEHIND_WINDOW, RayStatus.TOTAL_REFLECTION, RayStatus.OK]


def test_a_calibration_without_a_window_measures_along_straight_rays():
    bare = nominal("width").model_copy(update={"window": None})
    assert bare.window is None
    pixels = whole_image(50)
    found = points_on_sheet(bare, pixels, medium_index=WATER)
    ok = found.status == RayStatus.OK
    assert ok.sum() > 40
    np.testing.assert_allclose(project(bare.camera, found.points_mm[ok]), pixels[ok], rtol=0, atol=1e-10)


@pytest.mark.parametrize("stripe_along", ["width", "height"])
def test_the_object_frame_holds_the_sheet_at_x_0_and_the_stage_moves_it(stripe_along):
    calibration, pixels = nominal(stripe_along), whole_image(100)
    direction = np.array([0.8, 0.6, 0.0])
    stage = np.linspace(-50.0, 300.0, 100)
    still = reconstruct_pixels(calibration, pixels, medium_index=WATER, stage_mm=0.0, stage_direction=direction)
    moved = reconstruct_pixels(calibration, pixels, medium_index=WATER, stage_mm=stage, stage_direction=direction)
    near = (still.status == RayStatus.OK) & (np.abs(still.points_mm).max(axis=1) < 1e3)
    assert near.sum() > 60
    # Roundings of lengths up to 1e3 mm.
    np.testing.assert_allclose(still.points_mm[near, 0], 0.0, rtol=0, atol=2e-12)
    np.testing.assert_allclose((moved.points_mm - still.points_mm)[near], np.outer(stage, direction)[near], atol=1e-12)
    np.testing.assert_array_equal(moved.status, still.status)
    assert moved.points_mm.flags.c_contiguous
    camera_points = points_on_sheet(calibration, pixels, medium_index=WATER).points_mm[near]
    homogeneous = np.c_[still.points_mm[near], np.ones(near.sum())]
    np.testing.assert_allclose((homogeneous @ calibration.object_transform().T)[:, :3], camera_points, atol=1e-11)


def test_the_stages_direction_must_be_a_unit_vector():
    for direction in ([2.0, 0.0, 0.0], [0.0, 0.0, 0.0], [math.nan, 0.0, 0.0]):
        with pytest.raises(RangeError, match="unit vector"):
            to_object(nominal("width"), np.ones((1, 3)), stage_mm=0.0, stage_direction=direction)


@pytest.mark.parametrize("stripe_along", ["width", "height"])
def test_a_profiles_lines_are_columns_or_rows(stripe_along):
    calibration = nominal(stripe_along)
    lines, centres = np.arange(0.0, 1000.0, 50.0), np.linspace(400.0, 600.0, 20)
    pixels = np.stack([lines, centres] if stripe_along == "width" else [centres, lines], axis=1)
    common = {"medium_index": WATER, "stage_mm": 7.0, "stage_direction": (1.0, 0.0, 0.0)}
    profile = reconstruct_profile(calibration, lines, centres, **common)
    expected = reconstruct_pixels(calibration, pixels, **common)
    assert (profile.status == RayStatus.OK).all()
    np.testing.assert_array_equal(profile.points_mm, expected.points_mm)
    # The stripe runs along y of the object frame: neighbouring lines differ in y by far more than in depth.
    assert (np.abs(np.diff(profile.points_mm[:, 1])) > 3.0).all()


def test_the_pixels_of_many_frames_give_the_same_points_together_as_apart():
    calibration = nominal("width", distortion=Distortion(k1=-4.0))
    pixels = whole_image(10000)
    together = points_on_sheet(calibration, pixels, medium_index=WATER)
    apart = [points_on_sheet(calibration, part, medium_index=WATER) for part in np.split(pixels, [1, 3000, 7777])]
    status = np.concatenate([part.status for part in apart])
    np.testing.assert_array_equal(together.status, status)
    assert set(status) >= {RayStatus.OK, RayStatus.NO_DIRECTION}
    points = np.concatenate([part.points_mm for part in apart])
    near = points[:, 2] < 1e3
    assert near.sum() > 1000
    # The inverse of the distortion may take a step more or less in other company: 4e-15 over a slope of 1e-4 close to
    # the domain's edge, times 1e3 mm.
    np.testing.assert_allclose(together.points_mm[near], points[near], rtol=0, atol=1e-7)


def test_no_pixels_give_no_points():
    nothing = reconstruct_pixels(
        nominal("width"), np.empty((0, 2)), medium_index=WATER, stage_mm=0.0, stage_direction=(1.0, 0.0, 0.0)
    )
    assert nothing.points_mm.shape == (0, 3) and nothing.status.shape == (0,)


def test_arguments_are_left_as_they_were():
    calibration, pixels = nominal("width", distortion=Distortion(k1=-0.1)), whole_image(100)
    points = np.random.default_rng(9).uniform([-100, -80, 20], [100, 80, 400], (100, 3))
    before = pixels.copy(), points.copy()
    points_on_sheet(calibration, pixels, medium_index=WATER)
    project_through_window(calibration.camera, calibration.window, points, medium_index=WATER)
    to_object(calibration, points, stage_mm=1.0, stage_direction=(1.0, 0.0, 0.0))
    np.testing.assert_array_equal(pixels, before[0])
    np.testing.assert_array_equal(points, before[1])
