"""Shots of the study of methods: each is rendered once and photographed often, with fresh speckle and noise."""

from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING

import cv2
import numpy as np
from stripe_cases import FACING, PLATE, Case, step_per_px

from twin.rendering_options import ALL, Options
from twin.scene.description import Scene, load_scene
from twin.sensor.detector import electrons_per_ms, fixed_pattern, grey_values
from twin.sensor.speckle import Speckle, coherence
from uwlts.model.sensor import Sensor

if TYPE_CHECKING:
    # It loads Dr.Jit, which needs the library that `use_variant` chooses.
    from twin.light.renderer import LaserFrame

FINE_SPP = 256
"""Samples of the stripe itself: with 16, the few points in the pupil shift a blurred stripe by up to 0.2 px."""
SMOOTHED_LINES = 33
"""Lines over which noise of random walks is averaged: scattered light of a plate varies slowly along the stripe."""
APART = 3.0
"""Distance in renewal lengths; beyond 2, the speckle is independent."""


@dataclass(frozen=True, kw_only=True)
class Place(Case):
    """Case with a single rendered frame; ``turned_deg`` turns a plate about X (slanted stripe) and Y (depth)."""

    turned_deg: tuple[float, float] = (0.0, 0.0)

    def scene(self) -> Scene:
        changes = {"motion": {"start_mm": 0.0, "count": 1}, "medium": self.medium, "placement": "here"}
        changes["placements"] = {"here": {"position_mm": [0.0, 0.0, self.z_mm]}}
        if self.water is not None:
            changes["water"] = self.water
        if self.thing == "plane":
            changes["objects"] = [PLATE | {"rotation_deg": [*self.turned_deg, 0.0]}]
        return Scene.model_validate(load_scene(self.thing).model_dump() | changes)


@dataclass(frozen=True, eq=False)
class Rendered:
    """Light of a case without speckle and noise, and the truth (L,) in px on surfaces that face the laser."""

    sensor: Sensor
    index: float
    frame: "LaserFrame"
    truth_px: np.ndarray
    mm_per_px: np.ndarray
    exposure_ms: float

    def electrons(self, *, level: float = 1.0, speckle: int | None = None) -> np.ndarray:
        """Return mean electrons (H, W), with the speckle pattern of a number; ``level`` scales the exposure."""
        factors = 1.0 if speckle is None else self._grain(speckle)
        light = electrons_per_ms(
            self.frame.irradiance(factors),
            self.sensor.camera,
            self.sensor.detector,
            wavelength_nm=self.sensor.laser.wavelength_nm,
        )
        return light * np.float32(level * self.exposure_ms)

    def image(self, number: int, *, level: float = 1.0, speckle: bool = True) -> np.ndarray:
        """Grey values (H, W) of a photograph with its own noise and, if wanted, speckle."""
        camera, detector = self.sensor.camera, self.sensor.detector
        return grey_values(
            self.electrons(level=level, speckle=number if speckle else None),
            detector,
            exposure_ms=level * self.exposure_ms,
            rng=np.random.default_rng(number),
            pattern=fixed_pattern(detector, height=camera.height_px, width=camera.width_px),
        )

    def contrast(self) -> np.ndarray:
        """Contrast (P,) of the speckle of the stripe's pixels before it is averaged over their areas."""
        return self._coherence() * np.sqrt((1 + self.frame.polarisation**2) / 2)

    def _coherence(self) -> np.ndarray:
        laser = self.sensor.laser
        return coherence(
            self.frame.roughness_um,
            linewidth_nm=laser.linewidth_nm,
            wavelength_nm=laser.wavelength_nm,
            index=self.index,
        )

    def _grain(self, number: int) -> np.ndarray:
        frame = self.frame
        speckle = Speckle(self.sensor.camera, wavelength_nm=self.sensor.laser.wavelength_nm, seed=1)
        return speckle.factors(
            frame.rows,
            frame.columns,
            travel_mm=number * APART * speckle.renewal_mm,
            polarisation=frame.polarisation,
            coherence=self._coherence(),
        )


@cache
def render(place: Place) -> Rendered:
    """Render the light of a case: the stripe with many samples, the light around it with all effects of the case."""
    from twin.recording.frame_truth import find_true_stripe
    from twin.recording.sensor_simulator import SensorSimulator

    scene, sensor = place.scene(), place.sensor()
    still = place.effects.remove("noise", "speckle")
    whole = SensorSimulator(sensor, scene, Options(spp=place.spp, effects=still))
    pose = whole.pose(next(scene.motion.shots()))
    straight = still.remove("multiple-scattering", "secondary-light")
    fine = SensorSimulator(sensor.model_copy(update={"exposure": _fixed(sensor)}), scene, Options(effects=straight))
    frame = fine.renderer.laser_frame(pose, spp=FINE_SPP)
    around = whole.renderer.laser_frame(pose, spp=place.spp).scattered
    if place.thing == "plane":
        # A running sum in single precision may be slightly negative.
        around = np.maximum(cv2.blur(around, (SMOOTHED_LINES, 1), borderType=cv2.BORDER_REPLICATE), 0)
    truth = find_true_stripe(whole.renderer, pose)
    used = np.isfinite(truth.centre_px) & (-truth.normal[:, 2] >= FACING)
    step = step_per_px(place, truth.point_mm[None, :, 2])[0]
    return Rendered(
        sensor=sensor,
        index=whole.medium.refractive_index(sensor.laser.wavelength_nm),
        frame=replace(frame, longer=None, haze=around),
        truth_px=np.where(used, truth.centre_px, np.nan),
        mm_per_px=(step * truth.normal).sum(axis=-1),
        exposure_ms=whole.exposure_ms["laser"],
    )


def _fixed(sensor: Sensor):
    """Return the sensor with a fixed exposure, so that no automatic exposure is searched."""
    return sensor.exposure.model_copy(update={"laser_ms": 1.0})


PLACES = {"near": -60.0, "stand-off": 0.0, "far": 90.0}
CONVEX = ALL.remove("secondary-light")
"""Effects for the convex pipe, which does not illuminate itself."""


def places() -> dict[str, Place]:
    """Return the test cases of all methods, with all effects."""
    square = {f"plane, {name}": Place(z_mm=z, spp=8) for name, z in PLACES.items()}
    return square | {
        "sphere, near": Place(thing="spheres", z_mm=-40.0, spp=8),
        "sphere, far": Place(thing="spheres", z_mm=85.0, spp=8),
        "step, stand-off": Place(thing="step", spp=32),
        "PVC pipe, stand-off": Place(thing="pipe", effects=CONVEX, spp=8),
    }


LEVELS = (0.1, 0.3, 1.0, 2.0, 4.0, 8.0)
"""Exposures divided by the automatic one, which sets the brightest light to 0.8 of the full well."""


@dataclass(frozen=True)
class Spread:
    """Standard deviation of single lines.

    Errors above 2 px, at limbs and edges, are left out.
    """

    std_px: float
    std_mm: float

    @classmethod
    def of(cls, error_px: np.ndarray, mm_per_px: np.ndarray) -> "Spread":
        """Calculate from errors (F, L), NaN on lines without a centre."""
        error = np.where(np.abs(error_px) <= 2.0, error_px, np.nan)
        return cls(float(np.nanstd(error)), float(np.nanstd(error * mm_per_px)))
