"""Scans of spheres as evidence: derivatives, and that round spheres give away stage, water and their own size."""

from dataclasses import replace

import numpy as np
import pytest

from tests.unit.calibration_views import WATER, built_sensor
from uwlts.calibration.intrinsics import CameraOptions, Intrinsics
from uwlts.calibration.joint.estimate import estimate
from uwlts.calibration.joint.observations import STEP, Residuals
from uwlts.calibration.joint.parameters import Parameters, Prior, View
from uwlts.calibration.joint.sheet_jets import DescribedSheet
from uwlts.calibration.joint.sphere_scans import SLOPES, SphereScanEvidence
from uwlts.calibration.nominal import nominal_calibration
from uwlts.placement import camera_from_object, laser_pose
from uwlts.reconstruction import points_on_sheet

BUILT = built_sensor()
VIEW = View(True, 0)
STAGE = np.linspace(-16.0, 16.0, 9)
CENTRES = np.array([(0.0, -30.0, 45.0), (0.0, 32.0, 45.0)])
DIAMETERS = np.array([30.0, 34.0])
SLOPE = (0.004, -0.003)


def parameters(**std):
    """Everything as built and known, but for what ``std`` gives a standard uncertainty."""
    nominal, pose = nominal_calibration(BUILT), laser_pose(BUILT)
    window = nominal.window
    normal = np.array(window.normal) / window.normal[2]
    sheet = DescribedSheet(
        pose.normal, pose.axis, camera_from_object(BUILT)[:3, 3], pose.origin_mm, pose.origin_mm + 36.0 * pose.axis
    )
    known = {
        "window_distance": window.distance_mm, "window_slope_x": normal[0], "window_slope_y": normal[1],
        "glass_thickness": window.thickness_mm, "glass_index": window.glass_index, "index of water": WATER,
        "sheet_turn_fan": 0.0, "sheet_turn_axis": 0.0, "sheet_offset": 0.0, "stage_scale": 0.0,
    } | dict.fromkeys(SLOPES, 0.0)  # fmt: skip
    priors = {name: Prior(value, std.get(name.replace(" ", "_"), 1e-9)) for name, value in known.items()}
    camera = BUILT.camera
    intrinsics = Intrinsics(CameraOptions(), width_px=camera.width_px, height_px=camera.height_px)
    found = Parameters(intrinsics, sheet, window, ("water",), priors)
    return found, found.start(intrinsics.from_model(nominal.camera))


@pytest.fixture(scope="module")
def scan():
    """Pixels where the stripe lies on the spheres, found by bisection of the distance to the sphere."""
    frame = camera_from_object(BUILT)
    centres = CENTRES @ frame[:3, :3].T + frame[:3, 3]
    across = np.stack([frame[:3, 1], frame[:3, 2]])
    direction = frame[:3, 0] + SLOPE @ across
    direction /= np.linalg.norm(direction)
    known = nominal_calibration(BUILT)
    lines, grid = np.arange(150.0, 1150.0, 10.0), np.linspace(120.0, 900.0, 40)
    pixels, sphere, image = [], [], []
    for number, position in enumerate(STAGE):
        for which, (centre, diameter) in enumerate(zip(centres, DIAMETERS, strict=True)):

            def off(at, v, away=position * direction - centre, radius=diameter / 2):
                points = points_on_sheet(known, np.column_stack([at, v]), medium_index=WATER).points_camera_mm
                return np.linalg.norm(points + away, axis=1) - radius, points[:, 2]

            values, depth = (
                found.reshape(len(lines), -1) for found in off(np.repeat(lines, len(grid)), np.tile(grid, len(lines)))
            )
            crossed = (values[:, :-1] > 0) != (values[:, 1:] > 0)
            # A line meets a sphere twice; the side that faces the sensor is the nearer one.
            row = np.flatnonzero(crossed.any(axis=1))
            column = np.argmin(np.where(crossed, depth[:, :-1], np.inf)[row], axis=1)
            low, high = grid[column], grid[column + 1]
            rising = values[row, column] < 0
            for _ in range(50):
                middle = (low + high) / 2
                below = (off(lines[row], middle)[0] < 0) == rising
                low, high = np.where(below, middle, low), np.where(below, high, middle)
            pixels.append(np.column_stack([lines[row], (low + high) / 2]))
            sphere.append(np.full(len(row), which))
            image.append(np.full(len(row), number))
    evidence = SphereScanEvidence(
        view=VIEW, pixels=np.vstack(pixels), sphere=np.concatenate(sphere), frame=np.concatenate(image),
        stage_mm=STAGE, direction=frame[:3, 0], across_stage=across, diameters_mm=DIAMETERS - 0.3,
        diameter_std_mm=np.full(2, np.inf), across=1, image=0, source="spheres.h5",
    )  # fmt: skip
    own = np.concatenate([centres.ravel(), np.full(2, 0.3), np.zeros(len(STAGE))])
    return evidence, own


def test_points_lie_on_the_spheres(scan):
    model, shared = parameters()
    evidence, own = scan
    for name, slope in zip(SLOPES, SLOPE, strict=True):
        shared[model.names.index(name)] = slope
    assert len(evidence.pixels) > 300
    assert max(np.abs(part.values).max() for part in evidence.residuals(model, shared, own)) < 1e-7


def test_derivatives_are_what_differences_say(scan):
    """At vanishing residuals, where the scale of a residual does not matter; see the other evidence's test."""
    model, shared = parameters()
    evidence, own = scan
    for name, slope in zip(SLOPES, SLOPE, strict=True):
        shared[model.names.index(name)] = slope
    vector = np.concatenate([shared, own])
    found = evidence.residuals(model, shared, own)

    def residuals(values):
        parts = evidence.residuals(model, values[: len(shared)], values[len(shared) :])
        return np.concatenate([part.values for part in parts])

    analytic = np.zeros((len(evidence.pixels), len(vector)))
    row = 0
    for part in found:
        here = slice(row, row + len(part.values))
        analytic[here, : len(shared)] = part.by_shared
        analytic[here, len(shared) + part.own] = part.by_own
        row += len(part.values)
    for place, column in enumerate(analytic.T):
        reach = 1e-6 * max(1.0, abs(vector[place]))
        ahead, behind = vector.copy(), vector.copy()
        ahead[place] += reach
        behind[place] -= reach
        numeric = (residuals(ahead) - residuals(behind)) / (2 * reach)
        assert np.abs(column - numeric).max() <= 1e-4 * np.abs(numeric).max() + 1e-6, place


def noisy(evidence, sigma=0.02):
    noise = np.random.default_rng(8).normal(0, sigma, len(evidence.pixels))
    return replace(evidence, pixels=evidence.pixels + np.outer(noise, (0, 1)))


@pytest.mark.parametrize("known", [True, False], ids=["sizes known", "sizes unknown"])
def test_round_spheres_tell_the_stage_and_the_water(scan, known):
    """The lens is held by observations of its own: no target is needed for what the spheres tell."""
    evidence, own = scan
    model, shared = parameters(**dict.fromkeys(SLOPES, 0.01), index_of_water=2e-3)
    lens = len(model.intrinsics.names)
    held = _Held(shared[:lens].copy())
    diameters = np.full(2, 0.001 if known else np.inf)
    evidence = replace(noisy(evidence), diameters_mm=DIAMETERS.copy(), diameter_std_mm=diameters)
    start = own.copy()
    start[6:8] = 0.0
    result = estimate(model, [evidence, held], shared, [start, np.empty(0)], uncertainty=BUILT.uncertainty)
    values = dict(zip(result.parameters.names, result.values, strict=True))
    std = result.std()
    for name, true in (*zip(SLOPES, SLOPE, strict=True), ("index of water", WATER)):
        assert abs(values[name] - true) < 4 * std[name], name
        # That points on a sphere err together is stated, so that the uncertainty is far from what 0.02 px alone leave.
        assert std[name] < 3e-3, name
    assert np.abs(result.own[0][6:8]).max() < (0.01 if known else 0.1)
    assert result.noise["stripe on the spheres"].besides > 10


class _Held:
    """Evidence that holds the lens where it is."""

    def __init__(self, lens):
        self._lens = lens

    def own_std(self, *, alignment, position_mm):
        return np.empty(0)

    def residuals(self, parameters, shared, own):
        count = len(self._lens)
        by_shared = np.zeros((count, len(shared)))
        scale = 1e-6 * np.maximum(1e-3, np.abs(self._lens))
        by_shared[:, :count] = np.diag(1.0 / scale)
        return [
            Residuals(STEP, (shared[:count] - self._lens) / scale, by_shared, np.empty((count, 0)), np.arange(0), 0)
        ]

    def linearised(self, residuals, used):
        return self
