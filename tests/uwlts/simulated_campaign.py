"""Whole campaigns by Fermat's principle: all quantities with an uncertainty in the sensor's description are drawn."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.interpolate import CubicSpline

from tests.uwlts.calibration_views import STEP_MM, built_sensor, inside, lattice, turn
from tests.uwlts.joint_views import TARGET, gathered, lit_points, seen
from uwlts.calibration.camera.camera_parameters import TargetImage
from uwlts.calibration.capture_evidence import AirEvidence, StepEvidence
from uwlts.calibration.joint.gathering import Gathered, Series
from uwlts.calibration.joint.parameters import ViewMedium
from uwlts.model.artefacts import SphereStandard, StepStandard
from uwlts.model.placement import camera_from_object
from uwlts.model.sensor import Medium, Sensor

SPHERES = SphereStandard(kind="spheres", diameters_mm=(50.12, 50.14), spacings_mm=(99.18,))
PLACES_MM = {"near": -40.0, "standoff": 15.0, "far": 85.0}
FORMULA = 1.5e-5
"""Error of the formula of Quan and Fry for the index of water, as they state."""
# No stripe is found on surfaces with a smaller cosine of the angle of incidence.
_LEAST_COSINE = 0.4
_FEWEST_LIT = 50
_LENGTHENED = 12.93 / 12.5
"""Ratio of the true focal length to the drawn one, as for the sensor as built."""
_TRACED = 60


@dataclass(frozen=True)
class ModelErrors:
    """Errors that the joint calibration does not model and the description does not mention.

    ``distortion`` contains coefficients added to those of the lens. The target is a saddle, ``saddle_mm`` high at the
    middles of its edges, or twisted by ``twist_mm`` at its corners, and stretched along x by the fraction ``stretch``.
    Its gloss moves the stripe by ``gloss_px``. In the focus, the noise of circles and stripe is ``noise`` times the
    drawn one. At 100 mm from the focus, it is larger by a drawn fraction and ``blur``.
    """

    distortion: tuple[tuple[str, float], ...] = ()
    saddle_mm: float = 0.0
    twist_mm: float = 0.0
    stretch: float = 0.0
    gloss_px: float = 0.0
    noise: float = 1.0
    blur: float = 0.0


@dataclass(frozen=True, eq=False)
class Reality:
    """True properties of a sensor, its stage and its standards, which differ from drawings and certificates.

    ``lean`` (2,) are the slopes of the stage's direction against the target's normal. ``warmer_k`` is the error of the
    thermometer: true minus measured temperature of the water. ``target_saddle_mm`` is twice the height of the middles
    of the target's sides across x, ``target_twist_mm`` the height of its corners by a twist. ``stretch`` (2,) is the
    relative stretch of its columns and rows. The target's gloss moves the stripe by ``gloss_px``. ``circles_px`` and
    ``stripe_px`` are the noise in the focus, which is at the depth ``focus_mm`` of the OCS; the noise grows by the
    fraction ``blur`` within 100 mm.
    """

    sensor: Sensor
    bow: float
    warmer_k: float
    formula: float
    stage_scale: float
    lean: np.ndarray
    target_bow_mm: float
    step_mm: float
    circles_px: float
    stripe_px: float
    stage_mm: float
    rng: np.random.Generator
    target_saddle_mm: float
    target_twist_mm: float
    stretch: np.ndarray
    gloss_px: float
    blur: float
    focus_mm: float

    def noisier(self, z_mm: float) -> float:
        """Return the noise at a depth of the OCS, divided by that in the focus."""
        return 1 + self.blur * abs(z_mm - self.focus_mm) / 100

    def index(self, medium: Medium, drift_k: float = 0.0) -> float:
        """Return the index of a medium; for water, quadratic in the temperature, also beyond 30 degC."""
        if medium.kind == "air":
            return 1.0
        wavelength, at = self.sensor.laser.wavelength_nm, np.array([10.0, 20.0, 30.0])
        known = [medium.model_copy(update={"temperature_c": t}).refractive_index(wavelength) for t in at]
        return (
            float(np.polyval(np.polyfit(at, known, 2), medium.temperature_c + self.warmer_k + drift_k)) + self.formula
        )


def drawn_reality(
    described: Sensor,
    rng: np.random.Generator,
    *,
    spread: float = 1.0,
    errors: ModelErrors = ModelErrors(),
    apart: Mapping[str, float] | None = None,
) -> Reality:
    """Draw a sensor built from drawings.

    Quantities with a stated uncertainty are drawn with ``spread`` times this uncertainty, those in ``apart`` with the
    given factor times it. All others differ as in the sensor as built. The waist of the sheet scales the noise of the
    stripe, the focus moves the depth with the least noise, and the aperture sets how fast the noise grows from there.
    """
    stated = described.uncertainty
    known = stated.scaled(spread)
    for name, factor in (apart or {}).items():
        known = known.model_copy(update={name: getattr(stated.scaled(factor), name)})
    built = built_sensor()
    camera, window = described.camera, described.camera.window
    distortion = built.camera.distortion.model_dump()
    laser = described.laser.model_copy(update={"window": built.laser.window})
    distortion |= dict(zip(("p1", "p2"), rng.normal(0, known.tangential, 2), strict=True))
    for name, value in errors.distortion:
        distortion[name] += value
    as_drawn = window.normal()[:2] / window.normal()[2]
    slope_x, slope_y = as_drawn + np.tan(np.radians(known.window_tilt_deg)) * rng.standard_normal(2)
    # Of their own, so that the other draws of a seed do not depend on them.
    noise_rng = rng.spawn(1)[0]
    waist, blur, focus_mm = noise_rng.lognormal(0, 0.2), noise_rng.uniform(0, 0.5), noise_rng.normal(0, 20.0)
    bow, facing = np.radians([known.bow_deg, known.laser_window_tilt_deg]) * rng.standard_normal(2)
    window = window.model_copy(
        update={
            "distance_mm": window.distance_mm + rng.normal(0, known.window_distance_mm),
            "tilt_y_deg": float(np.degrees(np.arctan(slope_x))),
            "tilt_x_deg": float(np.degrees(np.arctan(-slope_y / np.hypot(1.0, slope_x)))),
            "thickness_mm": window.thickness_mm + rng.normal(0, known.glass_thickness_mm),
            "glass": window.index(laser.wavelength_nm) + rng.normal(0, known.glass_index),
        }
    )
    camera = camera.model_copy(
        update={
            "window": window,
            "distortion": built.camera.distortion.model_validate(distortion),
            "focal_length_mm": camera.focal_length_mm * _LENGTHENED + rng.normal(0, 0.03),
            "principal_point_px": tuple(camera.principal_point() + rng.normal((6.7, -5.6), 4.0)),
        }
    )
    facing_window = laser.window.model_copy(update={"tilt_y_deg": float(np.degrees(facing + bow))})
    laser = laser.model_copy(
        update={
            "window": facing_window,
            "baseline_mm": laser.baseline_mm + rng.normal(-0.8, 0.5),
            "triangulation_angle_deg": laser.triangulation_angle_deg + rng.normal(0.15, 0.1),
            "roll_deg": laser.roll_deg + rng.normal(0.25, 0.1),
        }
    )
    return Reality(
        sensor=built.model_copy(update={"camera": camera, "laser": laser}),
        bow=float(bow),
        warmer_k=rng.normal(0, known.temperature_k),
        formula=rng.normal(0, FORMULA),
        stage_scale=rng.normal(0, known.stage_scale),
        lean=np.tan(np.radians(known.stage_alignment_deg)) * rng.standard_normal(2),
        target_bow_mm=rng.normal(0, known.target_bow_mm),
        step_mm=STEP_MM + rng.normal(0, known.step_height_mm),
        circles_px=errors.noise * rng.uniform(0.03, 0.05),
        stripe_px=errors.noise * waist * rng.uniform(0.1, 0.15),
        stage_mm=known.stage_position_mm,
        rng=rng,
        target_saddle_mm=rng.normal(0, known.target_bow_mm) + 2 * errors.saddle_mm,
        target_twist_mm=rng.normal(0, known.target_bow_mm) + errors.twist_mm,
        stretch=rng.normal(0, known.stretch_by_axis()) + [errors.stretch, 0.0],
        gloss_px=rng.normal(0, known.target_stripe_px) + errors.gloss_px,
        blur=errors.blur + blur,
        focus_mm=focus_mm,
    )


@dataclass(frozen=True, eq=False)
class FanRays:
    """Rays of the fan behind the laser's window: points (N, 3) and steps (N, 3) along them, camera frame, mm."""

    points: np.ndarray
    steps: np.ndarray

    @classmethod
    @lru_cache(maxsize=4)
    def of(cls, real: Reality, index: float, count: int) -> "FanRays":
        """Construct rays from the points lit on two planes; behind the window, light runs straight.

        Rays are smooth over the fan: a spline through `_TRACED` rays has errors of 1e-5 mm between them.
        """
        frame = camera_from_object(real.sensor)
        between, wanted = np.linspace(-1, 1, _TRACED), np.linspace(-1, 1, count)
        near, far = (
            CubicSpline(
                between,
                lit_points(
                    real.sensor,
                    normal=frame[:3, 2],
                    point=frame[:3, 3] + depth * frame[:3, 2],
                    index=index,
                    bow=real.bow,
                    count=_TRACED,
                ),
            )(wanted)
            for depth in (-150.0, 150.0)
        )
        return cls(near, far - near)

    def on_plane(self, normal: np.ndarray, offset: np.ndarray | float) -> np.ndarray:
        """Return the intersections (N, 3) with a plane; its distance along the normal may differ from ray to ray."""
        return self.points + ((offset - self.points @ normal) / (self.steps @ normal))[:, None] * self.steps

    def on_sphere(self, centre: np.ndarray, radius: float) -> np.ndarray:
        """Return the first intersections (M, 3) of the rays that meet a sphere."""
        from_centre, length = self.points - centre, np.linalg.norm(self.steps, axis=1, keepdims=True)
        along = self.steps / length
        half = np.sum(from_centre * along, axis=1)
        under_root = half**2 - np.sum(from_centre**2, axis=1) + radius**2
        hit = under_root > 0
        return self.points[hit] - (half[hit] + np.sqrt(under_root[hit]))[:, None] * along[hit]


def stripe_noise(real: Reality, pixels: np.ndarray, z_mm: float) -> np.ndarray:
    """Add noise across the stripe to its pixels (N, 2) at a depth of the OCS."""
    noise = real.rng.normal(0, real.stripe_px * real.noisier(z_mm), len(pixels))
    return pixels + np.column_stack([np.zeros(len(pixels)), noise])


def target_series(
    real: Reality, *, view: ViewMedium, index: float, positions: np.ndarray, spacings: int, rays: int
) -> Series:
    """Simulate the bent target on the stage with the stripe on it; uses only circles every ``spacings``, for speed."""
    sensor = real.sensor
    frame = camera_from_object(sensor)
    placed = turn(*real.rng.normal(0, 0.005, 2), np.pi / 2 + real.rng.normal(0, 0.01))
    rotation = frame[:3, :3] @ placed
    direction = rotation @ [*real.lean, 1.0]
    direction /= np.linalg.norm(direction)
    grid = lattice(25, 25)
    x, y = np.round(grid[:, 0] / 9.375).astype(int), np.round(grid[:, 1] / 9.372).astype(int)
    flat = grid[(x % spacings == 0) & (y % spacings == 0)]
    corner = np.sum(grid[:, :2] ** 2, axis=1).max()

    def bulge(points: np.ndarray) -> np.ndarray:
        x2, y2, xy = points[:, 0] ** 2, points[:, 1] ** 2, points[:, 0] * points[:, 1]
        saddle, twist = real.target_saddle_mm * (x2 - y2), 2 * real.target_twist_mm * xy
        return (real.target_bow_mm * (x2 + y2) + saddle + twist) / corner

    bent = np.column_stack([flat[:, :2] * (1 + real.stretch), bulge(flat)])
    fan = FanRays.of(real, index, rays)
    images, stripes = [], []
    for position in positions:
        travel = position * (1 + real.stage_scale) + real.rng.normal(0, real.stage_mm)
        z_mm = 20.0 - position
        origin = frame[:3, 3] + 20.0 * frame[:3, 2] - travel * direction
        pixels = seen(sensor, bent @ rotation.T + origin, index=index, window=view.window)
        here = inside(pixels, sensor)
        found = pixels[here] + real.rng.normal(0, real.circles_px * real.noisier(z_mm), (here.sum(), 2))
        images.append(TargetImage(flat[here], found, float(position)))
        lit = fan.on_plane(rotation[:, 2], rotation[:, 2] @ origin)
        for _ in range(2):
            lit = fan.on_plane(rotation[:, 2], rotation[:, 2] @ origin + bulge((lit - origin) @ rotation))
        on_it = (np.abs((lit - origin) @ rotation)[:, :2] < 115.0).all(axis=1)
        pixels = seen(sensor, lit[on_it], index=index, window=view.window)
        stripes.append(stripe_noise(real, pixels[inside(pixels, sensor)], z_mm) + [0.0, real.gloss_px])
    evidence = AirEvidence(TARGET, images, [(0, n) for n in range(len(images))], stripes, [], captures=["target"])
    return Series(view, evidence, True)


def step_images(real: Reality, *, index: float, depths: np.ndarray, rays: int) -> list[tuple[StepEvidence, ViewMedium]]:
    """Simulate the stripe over a block on a plate, one image at each depth of the OCS."""
    frame, fan = camera_from_object(real.sensor), FanRays.of(real, index, rays)
    found = []
    for depth in depths:
        rotation = frame[:3, :3] @ turn(*real.rng.normal(0, 0.01, 2))
        normal, middle = rotation[:, 2], frame[:3, 3] + depth * frame[:3, 2]
        base = fan.on_plane(normal, normal @ middle)
        top = fan.on_plane(normal, normal @ middle - real.step_mm)
        shift = real.rng.uniform(-12.0, 12.0)
        on_top = np.abs((top - middle) @ rotation[:, 1] - shift) < 30.0
        lit = np.where(on_top[:, None], top, base)
        # Excludes the block's side and its shadow, and the plate's ends.
        along = np.abs((lit - middle) @ rotation[:, 1] - shift)
        lit = lit[on_top | ((along > 34.0) & (along < 75.0))]
        pixels = seen(real.sensor, lit, index=index, window=True)
        pixels = stripe_noise(real, pixels[inside(pixels, real.sensor)], float(depth))
        found.append(
            (StepEvidence(pixels, StepStandard(kind="step", height_mm=STEP_MM), index, "step"), ViewMedium(True, 0))
        )
    return found


def evidence(
    real: Reality, described: Sensor, *, wet: bool, images: int = 6, spacings: int = 2, rays: int = 150
) -> Gathered:
    """Simulate target images without and with the camera's window, in air or in water, and images of a step."""
    water = described.media["water"]
    index = real.index(water) if wet else 1.0
    size = {"spacings": spacings, "rays": rays}
    series = [
        target_series(real, view=ViewMedium(False, None), index=1.0, positions=np.linspace(-180, 60, images), **size),
        target_series(
            real,
            view=ViewMedium(True, 0 if wet else None),
            index=index,
            positions=np.linspace(-120, 60, images),
            **size,
        ),
    ]
    steps = step_images(real, index=index, depths=np.array([-45.0, 5.0, 75.0]), rays=rays) if wet else []
    return replace(gathered(described, series, steps), media={"water": water} if wet else {})


@dataclass(frozen=True, eq=False)
class ScanStripes:
    """Stripe centres of a scan: image, column and row (N,) of each, and reported stage positions (F,) in mm."""

    frame: np.ndarray
    line: np.ndarray
    centre_px: np.ndarray
    stage_mm: np.ndarray


def scan_of_spheres(
    real: Reality, *, index: float, place: str, positions: np.ndarray, lean: np.ndarray, rays: int = 800
) -> ScanStripes:
    """Simulate stripes on the sphere standard; the sensor moves along the sheet's normal, except for a lean (2,)."""
    frame, fan = camera_from_object(real.sensor), FanRays.of(real, index, rays)
    # A beam with a tilt at the line optics rotates the sheet's normal.
    frame[:3, :3] = frame[:3, :3] @ turn(0.0, real.bow, 0.0)
    direction = frame[:3, :3] @ [1.0, *lean]
    direction /= np.linalg.norm(direction)
    spun = turn(*np.radians(real.rng.normal(0, (5.0, 0.0, 5.0))))
    parts = []
    for number, position in enumerate(positions):
        travel = position * (1 + real.stage_scale) + real.rng.normal(0, real.stage_mm)
        for side, diameter in zip((-1, 1), SPHERES.diameters_mm, strict=True):
            centre = spun @ [0.0, side * SPHERES.spacings_mm[0] / 2, 0.0] + [0.0, 0.0, PLACES_MM[place]]
            centre = frame[:3, :3] @ centre + frame[:3, 3] - travel * direction
            lit = fan.on_sphere(centre, diameter / 2)
            outward = (lit - centre) / (diameter / 2)
            facing = -np.sum(outward * lit, axis=1) / np.linalg.norm(lit, axis=1)
            lit = lit[(facing > _LEAST_COSINE) & (outward @ -frame[:3, 2] > _LEAST_COSINE)]
            if len(lit) < _FEWEST_LIT:
                continue
            pixels = seen(real.sensor, lit, index=index, window=True)
            pixels = pixels[inside(pixels, real.sensor)]
            pixels = pixels[np.argsort(pixels[:, 0])]
            columns = np.arange(np.ceil(pixels[0, 0]), pixels[-1, 0])
            rows = CubicSpline(*pixels.T)(columns)
            parts.append((np.full(len(columns), number), columns.astype(int), rows))
    frame_of, line, rows = (np.concatenate(part) for part in zip(*parts, strict=True))
    noise = real.rng.normal(0, real.stripe_px * real.noisier(PLACES_MM[place]), len(rows))
    return ScanStripes(frame_of, line, rows + noise, positions)
