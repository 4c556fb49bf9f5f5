"""Evidence for the joint calibration, in air and in a medium, by Fermat's principle, without the sensor software."""

from dataclasses import dataclass, replace

import numpy as np

from tests.oracles.fermat import Face, directions_seen, plate, points_seen_on_plane
from tests.uwlts.calibration_views import (
    STEP_MM,
    WATER,
    built_sensor,
    inside,
    lattice,
    lens_of,
    nine_steps,
    through_window,
    turn,
)
from uwlts.calibration.calibrate import solve_jointly
from uwlts.calibration.camera.camera_parameters import TargetImage
from uwlts.calibration.capture_evidence import AirEvidence, StepEvidence
from uwlts.calibration.joint.gathering import Gathered, Series
from uwlts.calibration.joint.parameters import ViewMedium
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions
from uwlts.model.artefacts import StepStandard
from uwlts.model.calibration import Calibration
from uwlts.model.placement import camera_from_object, laser_pose
from uwlts.model.sensor import Medium, Sensor
from uwlts.targets import parse_target

MEDIUM = Medium(kind="custom", index=WATER)
TARGET = parse_target(
    {"kind": "circles", "diameter_mm": 5.0, "marker_diameter_mm": 2.0, "columns": 25, "rows": 25, "origin": (12, 12)}
    | {"spacing_x_mm": 9.375, "spacing_y_mm": 9.372}
)


@dataclass(frozen=True)
class Noise:
    """Standard deviations of the errors of views, and the random generator."""

    circles_px: float = 0.0
    stripe_px: float = 0.0
    stage_mm: float = 0.0
    rng: np.random.Generator | None = None

    def draw(self, sigma, shape):
        return self.rng.normal(0, sigma, shape) if sigma else np.zeros(shape)


def seen(sensor: Sensor, points, *, index, window):
    """Return pixels (N, 2) of points (N, 3) in the camera frame."""
    if not window:
        return lens_of(sensor).pixels(points)
    plate_of = sensor.camera.window
    faces = plate(distance=plate_of.distance_mm, thickness=plate_of.thickness_mm, normal=plate_of.normal())
    indices = [1.0, plate_of.index(sensor.laser.wavelength_nm), index]
    return lens_of(sensor).pixels(directions_seen(points, faces, indices))


def lit_points(sensor: Sensor, *, normal, point, index, bow=0.0, count=200):
    """Return the points (count, 3) of a plane lit by the fan through the laser's window, camera frame."""
    pose, window = laser_pose(sensor), sensor.laser.window
    module = np.stack([pose.normal, pose.fan, pose.axis])
    angle = np.linspace(-1, 1, count) * np.radians(sensor.laser.fan_angle_deg / 2)
    rays = np.column_stack([np.full(count, np.sin(bow)), np.cos(bow) * np.sin(angle), np.cos(bow) * np.cos(angle)])
    faces = plate(distance=window.distance_mm, thickness=window.thickness_mm, normal=window.normal())
    there, across = module @ (point - pose.origin_mm), module @ normal
    straight = rays * ((across @ there) / (rays @ across))[:, None]
    indices = [1.0, window.index(sensor.laser.wavelength_nm), index]
    found = points_seen_on_plane(rays, Face(there, across), straight, faces, indices)
    return found @ module + pose.origin_mm


def target_series(
    sensor, *, medium=None, window=True, positions, bow=0.0, noise=Noise(), tilts=None, columns=25, index=WATER
):
    """Return a series of the target with stripes: on the stage, or in free poses with ``tilts`` (F, 2) in rad."""
    index = 1.0 if medium is None else index
    frame = camera_from_object(sensor)
    direction = frame[:3, :3] @ np.array([0.002, -0.001, 1.0])
    images, stripes = [], []
    for number, position in enumerate(positions):
        by_hand = (0.0, 0.0) if tilts is None else tilts[number]
        rotation = frame[:3, :3] @ turn(0.004 + by_hand[0], -0.007 + by_hand[1], np.pi / 2 + 0.02)
        there = position + noise.draw(noise.stage_mm, ())
        origin = frame[:3, 3] + 20.0 * frame[:3, 2] - there * direction
        points = lattice(columns, columns)
        pixels = seen(sensor, points @ rotation.T + origin, index=index, window=window)
        here = inside(pixels, sensor)
        found = pixels[here] + noise.draw(noise.circles_px, (here.sum(), 2))
        images.append(TargetImage(points[here], found, float(position)))
        lit = lit_points(sensor, normal=rotation[:, 2], point=origin, index=index, bow=bow)
        pixels = seen(sensor, lit, index=index, window=window)
        pixels = pixels[inside(pixels, sensor)]
        stripes.append(pixels + np.column_stack([np.zeros(len(pixels)), noise.draw(noise.stripe_px, len(pixels))]))
    names = [(0, n) for n in range(len(images))]
    evidence = AirEvidence(TARGET, images, names, stripes, [], outliers=[0] * len(images), captures=["target"])
    return Series(ViewMedium(window, medium), evidence, None if tilts is not None else True)


def edited(series, edit=lambda number, image: image, *, every=1):
    """Return the series with each image replaced by ``edit(number, image)``, and ``every`` n-th pixel of stripes."""
    images = [edit(*each) for each in enumerate(series.found.images)]
    stripes = [pixels[::every] for pixels in series.found.stripes]
    return replace(series, found=replace(series.found, images=images, stripes=stripes))


def step_views(sensor: Sensor, *, noise=Noise(), tilts=(0.01, -0.02, 0.03)):
    """Return nine images of the step standard on the described sheet, without the effect of the laser's window."""
    standard = StepStandard(height_mm=STEP_MM)
    found = []
    for profile in nine_steps(count=400, tilts=tilts):
        pixels = through_window(sensor, profile, noise_px=noise.stripe_px, rng=noise.rng)
        found.append((StepEvidence(pixels, standard, WATER, "step"), ViewMedium(True, 0)))
    return found


def gathered(sensor: Sensor, series, steps=()) -> Gathered:
    """Return the evidence of captures with these views; ``sensor`` is the description by the drawings."""
    return Gathered(sensor, {"water": MEDIUM}, list(series), list(steps), [], {}, [])


def assert_derivatives(evidence, parameters, global_values, local, *, within):
    """Compare derivatives of residuals with central differences, to ``within`` times the largest of each column.

    If residuals vanish, the derivatives of their scale do not matter.
    """
    vector, count = np.concatenate([global_values, local]), len(global_values)
    found = evidence.residuals(parameters, global_values, local)

    def residuals(values):
        parts = evidence.residuals(parameters, values[:count], values[count:])
        return np.concatenate([part.values for part in parts])

    analytic, row = np.zeros((sum(len(part.values) for part in found), len(vector))), 0
    for part in found:
        here = np.arange(row, row := row + len(part.values))
        columns = np.r_[:count, count + part.local_columns]
        analytic[np.ix_(here, columns)] = np.hstack([part.by_global, part.by_local])
    for place, column in enumerate(analytic.T):
        reach = 1e-6 * max(1.0, abs(vector[place]))
        ahead, behind = vector.copy(), vector.copy()
        ahead[place] += reach
        behind[place] -= reach
        numeric = (residuals(ahead) - residuals(behind)) / (2 * reach)
        assert np.abs(column - numeric).max() <= within * np.abs(numeric).max() + 1e-6, place


def joint_calibration(sensor: Sensor, *, columns: int = 25) -> Calibration:
    """Return a joint calibration of the built sensor by six simulated poses of its target in water."""
    noise = Noise(circles_px=0.03, stripe_px=0.1, stage_mm=0.003, rng=np.random.default_rng(4))
    series = target_series(
        built_sensor(), medium=0, positions=np.arange(6) * 36.0 - 120.0, noise=noise, columns=columns
    )
    options = CalibrationOptions(poses="stage", correct_circles=False)
    return solve_jointly(gathered(sensor, [series]), options=options).calibration
