"""Speed of the renderer on a CUDA device: ``python -m tests.bench.gpu``; without a device, only prints a message.

Frames show two spheres in clear and in coastal water, with all effects. Measures the time to render single frames in
parts of several sizes, and frames/s of one and of several processes that share the device. The statistical tests run on
the device with ``TWIN_TEST_VARIANT=cuda_ad_mono make test-full``.
"""

import statistics
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
from cyclopts import App

from twin.rendering_options import GPU, use_variant
from uwlts.errors import SetupError

FRAMES = 40
WARM_UP = 3
WATERS = ("clear", "coastal")
SAMPLES_AT_ONCE = (2**21, 2**23, 2**25)
PROCESSES = (1, 2, 4, 8)


def frame_seconds(water: str, samples_at_once: int) -> float:
    """Return the median seconds to render the light of one frame in parts of at most ``samples_at_once`` samples."""
    use_variant(GPU)
    from tests.bench.light import in_named_water
    from twin.light import renderer as module
    from twin.rendering_options import Options
    from twin.scene.description import load_scene

    module.SAMPLES_AT_ONCE = samples_at_once
    sensor, seconds = in_named_water(water), []
    renderer = module.Renderer(sensor, sensor.media["water"], load_scene("spheres"))
    for seed in range(WARM_UP + FRAMES):
        start = time.perf_counter()
        renderer.irradiance("laser", np.eye(4), spp=Options().spp, seed=seed)
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds[WARM_UP:])


def frames_per_second(water: str, processes: int) -> float:
    """Return frames/s of several processes, from the first frame after their warm-up to the last frame."""
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        spans = list(pool.map(_rendered, [water] * processes))
    return processes * FRAMES / (max(end for _, end in spans) - min(start for start, _ in spans))


def _rendered(water: str) -> tuple[float, float]:
    """Return the start and end times of `FRAMES` frames."""
    use_variant(GPU)
    from tests.bench.light import in_named_water
    from twin.light.renderer import Renderer
    from twin.rendering_options import Options
    from twin.scene.description import load_scene

    sensor = in_named_water(water)
    renderer = Renderer(sensor, sensor.media["water"], load_scene("spheres"))
    for seed in range(WARM_UP):
        renderer.irradiance("laser", np.eye(4), spp=Options().spp, seed=seed)
    start = time.time()
    for seed in range(FRAMES):
        renderer.irradiance("laser", np.eye(4), spp=Options().spp, seed=WARM_UP + seed)
    return start, time.time()


def main() -> int:
    """Measure and print the results; exit code 0, also without a device."""
    try:
        use_variant(GPU)
    except SetupError as error:
        print(f"not measured: no CUDA device ({error})")
        return 0
    for water in WATERS:
        for samples in SAMPLES_AT_ONCE:
            print(f"{water} water, {samples} samples at once: {1e3 * frame_seconds(water, samples):.1f} ms a frame")
        for processes in PROCESSES:
            print(f"{water} water, {processes} in flight: {frames_per_second(water, processes):.0f} frames/s")
    return 0


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
