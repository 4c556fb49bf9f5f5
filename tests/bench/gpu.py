"""Correctness and speed of the twin on a CUDA device: ``python -m tests.bench.gpu``.

First the statistical tests of light, sensor and recordings run on the device. Then frames of two spheres in clear and
in coastal water, with all effects, are measured: the light of one frame in parts of several sizes, the light of several
processes that share the device, and recordings to disk (detector, speckle, truth and files included) by one and by
several processes. Without a device, only a message is printed; the exit code is 0.
"""

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from cyclopts import App

from twin.rendering_options import GPU, use_variant
from uwlts.errors import SetupError

FRAMES = 40
WARM_UP = 3
WATERS = ("clear", "coastal")
SAMPLES_AT_ONCE = (2**21, 2**23, 2**25)
PROCESSES = (1, 2, 4, 8)
TESTS = ("tests/twin/light", "tests/twin/sensor", "tests/twin/recording")


def frame_seconds(water: str, samples_at_once: int) -> float:
    """Return the median seconds to render the light of one frame in parts of at most ``samples_at_once`` samples."""
    use_variant(GPU)
    from tests.bench.light import in_named_water
    from twin.light import image_sampling, renderer as module
    from twin.rendering_options import Options
    from twin.scene.description import load_scene

    image_sampling.SAMPLES_AT_ONCE = samples_at_once
    sensor, seconds = in_named_water(water), []
    renderer = module.Renderer(sensor, sensor.media["water"], load_scene("spheres"))
    for seed in range(WARM_UP + FRAMES):
        start = time.perf_counter()
        renderer.laser_frame(np.eye(4), spp=Options().spp, seed=seed).irradiance()
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds[WARM_UP:])


def frames_per_second(work: Callable[[str], tuple[float, float]], water: str, processes: int) -> float:
    """Return frames/s of several processes, from the first frame after their warm-up to the last frame.

    ``work`` is `light_span` or `recording_span`.
    """
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        spans = list(pool.map(work, [water] * processes))
    return processes * FRAMES / (max(end for _, end in spans) - min(start for start, _ in spans))


def light_span(water: str) -> tuple[float, float]:
    """Return the start and end times of the light of `FRAMES` frames."""
    use_variant(GPU)
    from tests.bench.light import in_named_water
    from twin.light.renderer import Renderer
    from twin.rendering_options import Options
    from twin.scene.description import load_scene

    sensor = in_named_water(water)
    renderer = Renderer(sensor, sensor.media["water"], load_scene("spheres"))
    for seed in range(WARM_UP):
        renderer.laser_frame(np.eye(4), spp=Options().spp, seed=seed).irradiance()
    start = time.time()
    for seed in range(FRAMES):
        renderer.laser_frame(np.eye(4), spp=Options().spp, seed=WARM_UP + seed).irradiance()
    return start, time.time()


def recording_span(water: str) -> tuple[float, float]:
    """Return the start and end times of `FRAMES` frames of a recording on disk, as `twin simulate` writes it."""
    use_variant(GPU)
    from tests.bench.light import in_named_water
    from twin.recording.record_scene import record_scene
    from twin.scene.description import load_scene

    count = WARM_UP + FRAMES
    scene = load_scene("spheres", motion={"start_mm": -0.5 * count, "step_mm": 1.0, "count": count})
    moments: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        record_scene(
            scene,
            in_named_water(water),
            Path(folder, "spheres.h5"),
            progress=lambda done, total, stage="": moments.append(time.time()),
        )
    return moments[WARM_UP - 1], moments[-1]


def run_tests() -> int:
    """Run the tests of the twin on the device, the slow ones included, and return pytest's exit code."""
    environment = os.environ | {"TWIN_TEST_VARIANT": GPU}
    return subprocess.run([sys.executable, "-m", "pytest", "-q", *TESTS], env=environment, check=False).returncode


def main(*, tests: bool = True) -> int:
    """Run the tests and measure; exit code 1 if a test fails, and 0 without a device.

    Parameters
    ----------
    tests
        Run the statistical tests first.
    """
    try:
        use_variant(GPU)
    except SetupError as error:
        print(f"not measured: no CUDA device ({error})")
        return 0
    failed = run_tests() if tests else 0
    for water in WATERS:
        for samples in SAMPLES_AT_ONCE:
            print(f"{water} water, {samples} samples at once: {1e3 * frame_seconds(water, samples):.1f} ms a frame")
        for what, work in (("light", light_span), ("to disk", recording_span)):
            for processes in PROCESSES:
                speed = frames_per_second(work, water, processes)
                print(f"{water} water, {what}, {processes} in flight: {speed:.0f} frames/s")
    return 1 if failed else 0


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
