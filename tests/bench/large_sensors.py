"""Cost of large image sensors: frames rendered, stripes and points, by the pixels of the camera."""

import multiprocessing
import resource
import tempfile
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from tests.bench.rows import median_seconds
from tests.virtual_sensors import altered
from twin.recording.record_scene import record_scene
from twin.rendering_options import Options, use_variant
from twin.scene.description import load_scene
from uwlts.model.library import load_sensor
from uwlts.model.sensor import Sensor
from uwlts.optics.nominal import nominal_calibration
from uwlts.optics.triangulation import reconstruct_pixels
from uwlts.storage.capture import Capture
from uwlts.stripe import extract_stripe

FRAMES = 6
FINER = {"5 Mpx": 2, "12 Mpx": 3}
"""Pixels of a large sensor along each side, relative to 1280 x 1024 of the same size on the chip."""
LIT = 0.02
"""Grey values of lit pixels, of the full scale."""
WORK = {"recorded": "rendered to disk", "stripe": "to find its stripe", "points": "to reconstruct it"}
"""Stages of `Cost`."""


@dataclass(frozen=True)
class Cost:
    """Processor time in ms of a frame at each stage of `WORK`, its lit pixels, and the peak memory in GB."""

    ms: dict[str, float]
    lit_pixels: float
    peak_gb: float

    def per_lit_pixel(self, of: str, small: "Cost") -> float:
        """Return the cost of a stage per lit pixel, relative to that of a smaller sensor."""
        return self.ms[of] / self.lit_pixels / (small.ms[of] / small.lit_pixels)


def finer_sensor(finer: int) -> Sensor:
    """Return the thesis's sensor with ``finer`` times as many pixels along each side, on the same chip."""
    sensor = load_sensor("thesis")
    camera = sensor.camera
    pixels = {"width_px": finer * camera.width_px, "height_px": finer * camera.height_px}
    return altered(sensor, {"camera": pixels | {"pixel_size_um": camera.pixel_size_um / finer}})


def sensor_cost(finer: int) -> Cost:
    """Return the cost of a sensor, measured in a process of its own for its memory."""
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as name, context.Pool(1, use_variant) as pool:
        return pool.apply(_measure, (Path(name), finer))


def _measure(folder: Path, finer: int) -> Cost:
    sensor = finer_sensor(finer)
    images, recorded_ms = _record(folder / "spheres.h5", sensor)
    along, full_dn = sensor.camera.stripe_along, sensor.detector.full_scale_dn()
    medium = sensor.media["water"]
    calibration, index = nominal_calibration(sensor, medium), medium.refractive_index(sensor.laser.wavelength_nm)

    def find(k: int) -> np.ndarray:
        return extract_stripe(images[k % len(images)], stripe_along=along, saturation=full_dn).pixels()

    found, direction = find(0), np.array([1.0, 0.0, 0.0])
    reconstruct = partial(
        reconstruct_pixels, calibration, found, medium_index=index, stage_mm=0.0, stage_direction=direction
    )
    timed = partial(median_seconds, runs=31, clock=time.process_time)
    ms = {"recorded": recorded_ms, "stripe": 1e3 * timed(find), "points": 1e3 * timed(lambda k: reconstruct())}
    lit = float(np.mean([np.count_nonzero(image > LIT * full_dn) for image in images]))
    # ru_maxrss is in KiB.
    return Cost(ms, lit, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9)


def _record(path: Path, sensor: Sensor) -> tuple[list[np.ndarray], float]:
    """Record spheres with all effects; return the images, and the median processor time of a frame in ms."""
    moments = list[float]()

    def note(done: int, total: int) -> None:
        moments.append(time.process_time())

    scene = load_scene("spheres", motion={"start_mm": -0.5 * FRAMES, "step_mm": 1.0, "count": FRAMES + 2})
    record_scene(scene, sensor, path, options=Options(), progress=note)
    with Capture(path) as capture:
        images = [capture.image(k) for k in np.flatnonzero(capture.laser_on).tolist()]
    return images, 1e3 * float(np.median(np.diff(moments)[1:]))
