"""Rendering speed: frames with all effects, stock Mitsuba at equal noise, and a whole campaign."""

import itertools
import resource
import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np

from tests.stock_mitsuba import fog, stock_scene
from tests.virtual_sensors import altered
from twin.light.renderer import Renderer
from twin.recording.record_scene import record_scene
from twin.rendering_options import NONE, Options
from twin.scene.description import load_scene
from uwlts.model.library import load_sensor
from uwlts.model.sensor import Medium, Sensor

SPP = Options().spp
STOCK_SPP = 64
SEEDS = 12
STRIPE_SHARE = 0.05
"""Pixels brighter than this fraction of the peak belong to the stripe."""


def stripe_noise(images: np.ndarray, truth: np.ndarray) -> float:
    """Return the rms error of the stripe's pixels in runs (K, H, W) from the truth (H, W), divided by its peak."""
    stripe = truth > STRIPE_SHARE * truth.max()
    return float(np.sqrt(np.mean((images - truth)[:, stripe] ** 2)) / truth.max())


def recorded_frame(water: str) -> tuple[float, float]:
    """Return the median seconds from one recorded frame of two spheres to the next, and of processor time.

    The frames have all effects, detector, truth and disk.
    """
    sensor = in_named_water(water)
    motion = {"start_mm": -0.5 * SEEDS, "step_mm": 1.0, "count": SEEDS + 2}
    moments: list[tuple[float, float]] = []
    with tempfile.TemporaryDirectory() as folder:
        record_scene(
            load_scene("spheres", motion=motion),
            sensor,
            Path(folder, "spheres.h5"),
            options=Options(spp=SPP),
            progress=lambda done, total: moments.append((time.perf_counter(), time.process_time())),
        )
    seconds, processor_s = np.median(np.diff(moments, axis=0)[1:], axis=0)
    return float(seconds), float(processor_s)


def in_named_water(water: str) -> Sensor:
    sensor = load_sensor("thesis-as-built")
    table = sensor.media["water"].model_dump(include={"kind", "temperature_c"})
    return sensor.model_copy(
        update={"media": {**sensor.media, "water": Medium.model_validate(table | {"water": water})}}
    )


def rendered_light(water: str) -> tuple[float, float]:
    """Return the median seconds to render the light of a frame of two spheres, and its noise divided by the peak.

    The truth is the mean of all frames, which lowers the error slightly; the result is corrected for this.
    """
    sensor = in_named_water(water)
    renderer = Renderer(sensor, sensor.media["water"], load_scene("spheres"))
    images, seconds = [], []
    for seed in range(SEEDS + 2):
        start = time.perf_counter()
        images.append(renderer.laser_frame(np.eye(4), spp=SPP, seed=seed).irradiance())
        seconds.append(time.perf_counter() - start)
    kept = np.stack(images[2:])
    noise = stripe_noise(kept, kept.mean(axis=0)) * np.sqrt(SEEDS / (SEEDS - 1))
    return statistics.median(seconds[2:]), noise


def equal_noise_advantage() -> tuple[float, str]:
    """Return the ratio of the times of stock `volpath` and the twin for equal noise on the same scene, and a summary.

    Stock Mitsuba can render the scene: no windows, a fog with coastal water's coefficients, a plate, and a projector
    of the sheet, 0.15 mm wide at the stand-off. Noise is the rms error of the stripe's pixels. The time of stock
    Mitsuba is extrapolated with 1 / sqrt(N). The twin is compared with a mean of many more samples.
    """
    bare = {"window": {"mounted": False}}
    sensor = altered(load_sensor("thesis"), {"camera": bare, "laser": bare})
    # A projector's light starts from a point. At the stand-off, it is as wide as the sheet at its waist.
    sigma = 0.5 * sensor.laser.waist_radius_mm / sensor.laser.waist_distance_mm
    waist = 1e-6 * sensor.laser.wavelength_nm / (2 * np.pi * sigma)
    thrown = altered(sensor, {"laser": {"waist_radius_mm": waist, "beam_quality_m2": 1.0}})
    coastal = Medium(kind="fresh", water="coastal")
    a, b = (1e3 * f(635.0) for f in (coastal.absorption_per_mm, coastal.scattering_per_mm))
    medium = fog(absorption_per_m=a, scattering_per_m=b, phase="henyey-greenstein", asymmetry=0.924)
    scene = load_scene("plane", medium="air")
    effects = replace(NONE, haze=True, multiple_scattering=True, secondary_light=True)
    renderer = Renderer(sensor, medium, scene, effects=effects)
    for seed in range(2):
        renderer.laser_frame(np.eye(4), spp=STOCK_SPP, seed=seed).irradiance()
    start = time.perf_counter()
    ours = np.stack([renderer.laser_frame(np.eye(4), spp=STOCK_SPP, seed=seed).irradiance() for seed in range(SEEDS)])
    our_seconds = (time.perf_counter() - start) / SEEDS
    truth = np.mean(
        [renderer.laser_frame(np.eye(4), spp=8 * STOCK_SPP, seed=100 + k).irradiance() for k in range(8)], axis=0
    )
    our_noise = stripe_noise(ours, truth)
    stock = stock_scene(thrown, medium, scene, across_texels=64)
    volpath = mi.load_dict({"type": "volpath", "max_depth": -1})
    start = time.perf_counter()
    theirs = np.stack([np.array(mi.render(stock, integrator=volpath, spp=STOCK_SPP, seed=k))[..., 0] for k in range(3)])
    their_seconds = (time.perf_counter() - start) / len(theirs)
    mean = theirs.mean(axis=0)
    scale = truth.max() / np.quantile(mean[truth > 0.9 * truth.max()], 0.5)
    spread = stripe_spread(theirs * scale, truth)
    ratio = (spread / our_noise) ** 2 * their_seconds / our_seconds
    how = (
        f"stock {their_seconds:.1f} s at noise {100 * spread:.1f} % of the peak, "
        f"twin {our_seconds:.2f} s at {100 * our_noise:.2f} %, both {STOCK_SPP} samples"
    )
    return ratio, how


def stripe_spread(images: np.ndarray, truth: np.ndarray) -> float:
    """Return the rms scatter of the stripe's pixels between runs (K, H, W), divided by the stripe's peak."""
    stripe = truth > STRIPE_SHARE * truth.max()
    return float(np.sqrt(images.var(axis=0, ddof=1)[stripe].mean()) / truth.max())


def campaign(folder: Path) -> tuple[int, float, float, float]:
    """The thesis's spheres in air and water and its calibration: frames, seconds, GiB, and late over early frames.

    ``folder`` gets the captures: a target in air, steps near, at the stand-off and far, a target in water, and spheres.
    """
    as_built = load_sensor("thesis-as-built")
    recordings = [("target", {}, 0), *(("step", {"placement": place}, 0) for place in ("near", "standoff", "far"))]
    recordings.append(("target-through-window", {"medium": "water", "motion": _in_water()}, 0))
    for medium, place, seed in itertools.product(("air", "water"), ("near", "standoff", "far"), (1, 2)):
        recordings.append(("spheres", {"medium": medium, "placement": place}, seed))
    moments: list[float] = []
    start = time.perf_counter()
    for number, (name, changes, seed) in enumerate(recordings):
        record_scene(
            load_scene(name, **changes),
            load_sensor("thesis"),
            folder / f"{number}.h5",
            as_built=as_built,
            options=Options(seed=seed),
            progress=lambda done, total: moments.append(time.perf_counter()),
        )
    seconds = time.perf_counter() - start
    steps = np.diff(moments)
    # The spheres in water are the last half of the campaign; both thirds contain near, stand-off and far.
    late, early = (np.median(part) for part in (steps[-38:], steps[-6 * 38 : -5 * 38]))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return len(moments), seconds, peak, float(late / early)


def _in_water() -> dict[str, object]:
    """The plate's 23 places in water, as the thesis takes them for its polynomial."""
    return {"direction": (0.0, 0.0, 1.0), "start_mm": -120.0, "step_mm": 10.0, "count": 23, "lights": ("lamp", "laser")}
