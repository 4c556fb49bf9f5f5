"""Derivatives of camera, window and sheet compared with finite differences."""

import cv2
import numpy as np
import pytest

from uwlts.model.calibration import CameraModel, FanModel, SheetModel, WindowModel
from uwlts.model.sensor import Distortion
from uwlts.optics.camera import image_derivatives
from uwlts.optics.triangulation import sheet_surface
from uwlts.optics.window import trace_derivatives, trace_window

CAMERA = CameraModel(width_px=1280, height_px=1024, fx_px=2400.0, fy_px=2410.0, cx_px=650.0, cy_px=500.0)
LENSES = [
    Distortion(k1=-0.21, k2=0.13, p1=0.004, p2=-0.003, k3=0.05),
    Distortion(k1=0.31, k2=0.13, p1=0.004, p2=-0.003, k3=0.05, k4=0.52, k5=-0.3, k6=0.2),
]
PIXELS = np.random.default_rng(1).uniform([0, 0], [1279, 1023], (20, 2))


def unit(*vector: float) -> tuple[float, ...]:
    """The vector (3,) of length one."""
    return tuple((np.array(vector) / np.linalg.norm(vector)).tolist())


WINDOWS = [
    WindowModel(refractions=1, distance_mm=47.0, normal=unit(0.05, -0.08, 1.0)),
    WindowModel(refractions=2, distance_mm=47.0, normal=unit(-0.03, 0.06, 1.0), thickness_mm=8.0, glass_index=1.52),
]
WATER = 1.333


def ideal(values: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Ideal image coordinates (2, N) by OpenCV's iteration; ``values`` are fx, fy, cx, cy, k1, k2, p1, p2, k3 to k6."""
    matrix = np.array([[values[0], 0, values[2]], [0, values[1], values[3]], [0, 0, 1]])
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-14)
    return cv2.undistortPoints(pixels[:, None], matrix, values[4:], criteria=stop)[:, 0].T


@pytest.mark.parametrize("lens", LENSES, ids=["Brown-Conrady", "rational"])
def test_ideal_coordinates_by_pixel_lens_and_all_distortions(lens):
    camera = CAMERA.model_copy(update={"distortion": lens})
    values = np.array([camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, *lens.model_dump().values()])
    found = image_derivatives(camera, PIXELS, ideal(values, PIXELS))
    assert found.shape == (14, 2, len(PIXELS))
    for column in range(14):
        step = np.zeros(14)
        step[column] = 1e-2 if column < 6 else 1e-5

        def at(sign: float, step: np.ndarray = step) -> np.ndarray:
            return ideal(values + sign * step[2:], PIXELS + sign * step[:2])

        differences = (at(1) - at(-1)) / (2 * step[column])
        np.testing.assert_allclose(
            found[column], differences, atol=2e-6 * np.abs(differences).max(), rtol=0, err_msg=str(column)
        )


@pytest.mark.parametrize("window", WINDOWS, ids=["one refraction", "two refractions"])
def test_rays_behind_a_window_by_direction_window_and_medium(window):
    rng = np.random.default_rng(2)
    flat, turn = rng.uniform(-0.3, 0.3, (2, 20)), rng.normal(size=(2, 3, 20))

    def directions(moved: np.ndarray) -> np.ndarray:
        raw = np.vstack([flat, np.ones(20)]) + np.einsum("c,cin->in", moved, turn)
        return raw / np.linalg.norm(raw, axis=0)

    rays, step = directions(np.zeros(2)), 1e-6
    rays_by = np.stack([(directions(moved) - directions(-moved)) / (2 * step) for moved in step * np.eye(2)])
    found = trace_derivatives(rays, rays_by, window, medium_index=WATER)
    plain = trace_window(rays.T, window, medium_index=WATER)
    np.testing.assert_allclose(found.origins, plain.origins.T, atol=1e-12)
    np.testing.assert_allclose(found.directions, plain.directions.T, atol=1e-14)

    def traced(change: np.ndarray) -> np.ndarray:
        slopes = np.array(window.normal[:2]) / window.normal[2] + change[3:5]
        normal = unit(*slopes, 1.0)
        moved = window.model_copy(
            update={
                "distance_mm": window.distance_mm + change[2],
                "normal": normal,
                "thickness_mm": window.thickness_mm + change[5],
                "glass_index": window.glass_index + change[6],
            }
        )
        through = trace_window(directions(change[:2]).T, moved, medium_index=WATER + change[7])
        return np.stack([through.origins.T, through.directions.T])

    for column, change in enumerate(step * np.eye(8)):
        differences = (traced(change) - traced(-change)) / (2 * step)
        for name, by, wanted in zip(
            ("origins_by", "directions_by"), (found.origins_by, found.directions_by), differences, strict=True
        ):
            np.testing.assert_allclose(by[column], wanted, atol=2e-7, rtol=1e-6, err_msg=f"{name}, {column}")


def test_rays_that_a_window_reflects_have_no_derivatives():
    straight = np.array([[0.0], [0.0], [1.0]])
    steep = np.array([[0.8], [0.0], [0.6]])
    from_water = WindowModel(refractions=1, distance_mm=47.0)
    none = np.zeros((1, 3, 1))
    assert trace_derivatives(straight, none, from_water, medium_index=0.75) is not None
    assert trace_derivatives(steep, none, from_water, medium_index=0.75) is None
    assert trace_derivatives(-straight, none, from_water, medium_index=WATER) is None
    both = np.hstack([straight, steep])
    assert trace_derivatives(both, np.zeros((1, 3, 2)), from_water, medium_index=0.75) is None


@pytest.mark.parametrize(("bow", "turn"), [(0.01, 0.0), (0.0, 0.012), (0.01, -0.008)])
def test_the_sheets_gradient_and_where_rays_cross_it(bow, turn):
    """Neither a tilted beam alone nor a turned window alone leaves a plane; rays end on the surface."""
    axis, normal = (0.28, 0.0, 0.96), (0.96, 0.0, -0.28)
    fan = FanModel(
        axis=axis, apex_mm=(-120.0, 0.0, 0.0), pivot_mm=(-110.0, 0.0, 34.3), bow_rad=bow, window_turn_rad=turn
    )
    surface = sheet_surface(SheetModel(normal=normal, offset_mm=-115.2, fan=fan), medium_index=WATER)
    assert not surface.is_plane()
    rng = np.random.default_rng(3)
    points = np.vstack([rng.uniform(-20, 20, 20), rng.uniform(-70, 70, 20), rng.uniform(250, 400, 20)])
    gradient = surface.gradient(points)
    flat = surface.normal @ points - surface.offset_mm
    assert np.abs(surface.miss_mm(points) - flat).max() > 1e-3
    for coordinate, step in enumerate(1e-3 * np.eye(3)):
        ahead, behind = (surface.miss_mm(points + sign * step[:, None]) for sign in (1, -1))
        np.testing.assert_allclose(gradient[coordinate], (ahead - behind) / 2e-3, atol=1e-8)
    origins, directions = rng.uniform(-5, 5, (3, 20)), np.vstack([rng.uniform(-0.1, 0.1, (2, 20)), np.ones(20)])
    reach, slope = surface.crossings(origins, directions)
    at = origins + reach * directions
    np.testing.assert_allclose(surface.miss_mm(at), 0.0, atol=1e-9)
    np.testing.assert_allclose(slope, np.sum(surface.gradient(at) * directions, axis=0), atol=1e-9)


def test_a_sheet_that_nothing_bends_is_a_plane():
    fan = FanModel(
        axis=(0.0, 0.0, 1.0), apex_mm=(0.0, 0.0, 0.0), pivot_mm=(0.0, 0.0, 30.0), bow_rad=0.0, window_turn_rad=0.0
    )
    surface = sheet_surface(SheetModel(normal=(1.0, 0.0, 0.0), offset_mm=2.0, fan=fan), medium_index=WATER)
    assert surface.is_plane()
    points = np.random.default_rng(4).normal(size=(3, 5))
    np.testing.assert_allclose(surface.miss_mm(points), points[0] - 2.0, atol=1e-12)
    np.testing.assert_allclose(surface.gradient(points), np.repeat([[1.0], [0.0], [0.0]], 5, axis=1), atol=1e-12)
