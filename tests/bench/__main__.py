"""Compare speed and memory with the project's limits: ``python -m tests.bench``; writes ``runs/bench.json``.

With names of sections as arguments, only these are measured. Times are medians after a warm-up, without compilation.
Limits are for two cores.
"""

import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

from cyclopts import App

# As in the commands (`uwlts.runtime.console.run`), before NumPy is imported: measurements on one core must not wait for
# a matrix library's thread on another, busy core, which took half of the time.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from twin.options import use_variant

RESULT = Path("runs/bench.json")
CORES = 2


@dataclass(frozen=True)
class Row:
    """Measured value and its limit; ``ok`` is True if the value is within the limit."""

    name: str
    value: float
    unit: str
    limit: float
    ok: bool


def at_most(name: str, value: float, unit: str, limit: float) -> Row:
    """Return a row with a value that must not exceed the limit."""
    return Row(name, round(float(value), 4), unit, limit, bool(value <= limit))


def at_least(name: str, value: float, unit: str, limit: float) -> Row:
    """Return a row with a value that must reach the limit."""
    return Row(name, round(float(value), 4), unit, limit, bool(value >= limit))


def median_seconds(action: Callable[[int], object], *, warm_up: int = 3, runs: int = 15) -> float:
    """Return the median duration of ``action(k)`` after a warm-up."""
    seconds = []
    for k in range(warm_up + runs):
        start = time.perf_counter()
        action(k)
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds[warm_up:])


def rendering() -> list[Row]:
    """Time of a full-size laser frame and a lamp frame of the thesis's sensor."""
    from twin.light.renderer import Renderer
    from twin.options import NONE
    from twin.scene.description import load_scene
    from uwlts.model.library import load_sensor

    sensor = load_sensor("thesis-as-built")

    def pose(k: int) -> np.ndarray:
        transform = np.eye(4)
        transform[0, 3] = 0.5 * (k - 8)
        return transform

    spheres, pipe = (
        Renderer(sensor, sensor.media["water"], load_scene(name), effects=replace(NONE, haze=True))
        for name in ("spheres", "pipe")
    )
    limit = 0.25
    return [
        at_most(
            "sharp laser frame 1280 x 1024, 64 samples per lit pixel, spheres in water",
            median_seconds(lambda k: spheres.irradiance("laser", pose(k), spp=64)),
            "s",
            limit,
        ),
        at_most(
            "sharp laser frame 1280 x 1024, 64 samples per lit pixel, pipe across the whole image in water",
            median_seconds(lambda k: pipe.irradiance("laser", pose(k), spp=64)),
            "s",
            limit,
        ),
    ]


def light() -> list[Row]:
    """Time and noise of frames with all effects at the default samples, and the advantage over stock Mitsuba.

    The time limits were set for the noise of 64 samples in an earlier version.
    """
    from tests.bench import light as bench_light

    rows = []
    for water, limit, most_noise in (("clear", 0.12, 0.25), ("coastal", 0.25, 0.66)):
        seconds, noise = bench_light.rendered_light(water)
        recorded = bench_light.recorded_frame(water)
        rows.append(
            at_most(f"laser frame with all effects, speckle to disk, spheres in {water} water", recorded, "s", limit)
        )
        rows.append(
            at_most(f"the same: its light alone, before speckle and detector, {water} water", seconds, "s", limit)
        )
        rows.append(at_most(f"the same: noise of its light, {water} water", 100 * noise, "% of peak", most_noise))
    advantage, how = bench_light.equal_noise_advantage()
    rows.append(at_least(f"advantage over volpath at equal noise ({how})", advantage, "times", 1000))
    return rows


def campaign() -> list[Row]:
    """Speed of a campaign of the thesis: record it, calibrate jointly from it, and measure with it on one core."""
    from tests.bench.calibration import joint_calibration, measuring_rate
    from tests.bench.light import campaign as recorded

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        frames, seconds, peak, growth = recorded(folder)
        target, *steps, in_water = (folder / f"{number}.h5" for number in range(5))
        calibration, finding, estimating = joint_calibration([target, in_water], steps)
        cv2.setNumThreads(1)
        by_stage, by_path = measuring_rate([folder / "13.h5", folder / "14.h5"], calibration)
    return [
        at_most(f"campaign of {frames} frames", seconds, "s", 60),
        at_most("campaign, peak memory", peak, "GiB", 3),
        at_most("campaign, time of the last frames over that of earlier ones", growth, "times", 1.3),
        at_most("joint calibration: targets and stripes found in its images", finding, "s", 3),
        at_most("joint calibration: the estimate", estimating, "s", 3),
        at_least("spheres in water: stripes, points and their covariance", by_stage, "frames/s", 1000),
        at_least("the same along a trajectory", by_path, "frames/s", 1000),
    ]


def pipeline() -> list[Row]:
    """Time of stripe extraction and reconstruction on one core: the default method, and the fastest one."""
    from twin.options import Options
    from twin.recording.sensor_simulator import SensorSimulator
    from twin.scene.description import load_scene
    from uwlts.model.library import load_sensor
    from uwlts.optics.nominal import nominal_calibration
    from uwlts.optics.triangulation import reconstruct_pixels
    from uwlts.stripe import StripeOptions, extract_stripe
    from uwlts.targets import parse_target

    rows = []
    cv2.setNumThreads(1)
    # Dark lines are searched for a dim stripe, which takes longer than measuring a bright one.
    default, fastest, limit_ms = StripeOptions().method, "zero-crossing", 0.7
    for along, scene, stripe, method in (
        ("width", load_scene("pipe"), "stripe on every column", default),
        ("width", load_scene("pipe"), "stripe on every column", fastest),
        ("height", load_scene("pipe"), "stripe on every row", default),
        ("height", load_scene("pipe"), "stripe on every row", fastest),
        ("width", load_scene("spheres"), "two spheres, a third of the columns dark", default),
    ):
        sensor = load_sensor("thesis")
        sensor = sensor.model_copy(update={"camera": sensor.camera.model_copy(update={"stripe_along": along})})
        medium = sensor.media[scene.medium]
        calibration = nominal_calibration(sensor, medium)
        index = medium.refractive_index(sensor.laser.wavelength_nm)
        shots = list(scene.motion.shots())
        image = SensorSimulator(sensor, scene, Options()).image(shots[len(shots) // 2], 0)
        extract = partial(
            extract_stripe,
            image,
            stripe_along=along,
            saturation=sensor.detector.full_scale_dn(),
            options=StripeOptions(method=method),
        )
        reconstruct = partial(
            reconstruct_pixels, calibration, medium_index=index, stage_mm=0.0, stage_direction=np.array([1.0, 0.0, 0.0])
        )
        extraction = median_seconds(lambda k, extract=extract: extract(), runs=101)
        both = median_seconds(lambda k, extract=extract, then=reconstruct: then(extract().pixels()), runs=101)
        rows.append(at_most(f"{method}, {stripe}", 1e3 * extraction, "ms/frame", limit_ms))
        rows.append(at_least(f"{method} and reconstruction on one core, {stripe}", 1 / both, "frames/s", 1000))
    scene = load_scene("target")
    target = parse_target(scene.target)
    lamp = next(shot for shot in scene.motion.shots() if shot.light == "lamp")
    image = SensorSimulator(load_sensor("thesis"), scene, Options()).image(lamp, 0)
    seconds = median_seconds(lambda k: target.detect(image), runs=11)
    found = len(target.detect(image).pixels)
    return [*rows, at_most(f"the {found} circles of a target in view found, on one core", seconds, "s", 0.3)]


def reproduction() -> list[Row]:
    """Time per image of the thesis's campaign, its scans thinned: 3,000 images in half an hour are 600 ms."""
    from twin.recording.campaigns import record_campaigns
    from twin.scene.campaign import load_campaign

    images = 0

    def count(done: int, total: int) -> None:
        nonlocal images
        images = total

    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        record_campaigns(load_campaign("thesis"), Path(folder), seeds=range(1), every=30, progress=count)
        seconds = time.perf_counter() - start
    return [at_most(f"the thesis's campaign, thinned to {images} images", 1e3 * seconds / images, "ms/image", 500)]


def studies() -> list[Row]:
    """Speed of design studies."""
    from tests.bench.study import screening, verification

    rate, engine = screening()
    return [
        at_least("designs judged by formulas, two workers", rate, "designs/s", 50000),
        at_most("the engine's share of two workers' time", 100 * engine, "%", 5),
        at_most("one design verified by rendering", verification(), "s", 30),
    ]


def datasets() -> list[Row]:
    """Measure frames per second of a data set: single scattering, 640 x 512 pixels, from light to labelled files.

    Two workers share memory and caches, so their limit is a tenth below twice the rate of one.
    """
    from tests.bench.dataset import rate_hz

    one, two = (rate_hz(workers=workers) for workers in (1, 2))
    return [
        at_least("data set stripe-clean, two workers", two, "frames/s", 10),
        at_least("the same: two workers by one", two / one, "times", 1.8),
    ]


def hardware() -> list[Row]:
    """Frames per second from a camera to the disk, alone and with stripe and points found meanwhile."""
    from tests.bench.recording import RATE_HZ, SERVED, TAKEN, following_rate, gige_recording, recording

    alone, live, gige = recording(), recording(live=True), gige_recording()
    return [
        at_least(f"camera to disk, {TAKEN} frames at {RATE_HZ:g}/s", alone.rate_hz, "frames/s", 0.99 * RATE_HZ),
        at_most("the same: lost", alone.lost, "frames", 0),
        at_least("the same while another process follows the file", live.rate_hz, "frames/s", 0.99 * RATE_HZ),
        at_most("the same: lost", live.lost, "frames", 0),
        at_least("the follower, with stripe and points", live.followed_hz, "frames/s", 0.99 * RATE_HZ),
        at_least("the follower: frames", live.followed, "frames", TAKEN),
        at_most("the follower: behind at the end", live.behind_s, "s", 0.25),
        at_least("the follower's work on frames from memory", following_rate(), "frames/s", 300),
        at_least(f"GigE Vision on loopback to disk, {SERVED} frames", gige.rate_hz, "frames/s", 0.998 * RATE_HZ),
        at_most("the same: lost", gige.lost, "frames", 0),
    ]


def demo() -> list[Row]:
    """Duration and peak memory of the demo, in a folder of its own."""
    environment = os.environ | {"PYTHONPATH": str(Path.cwd())}
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        command = [sys.executable, "-m", "twin", "demo"]
        subprocess.run(command, cwd=folder, env=environment, check=True, stdout=subprocess.DEVNULL)
        seconds = time.perf_counter() - start
    # ru_maxrss of the children is the largest single process; the demo runs two at a time.
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20
    return [at_most("demo", seconds, "s", 60), at_most("demo, peak memory of a process", peak, "GiB", 1.5)]


def commands() -> list[Row]:
    """Time until a command answers and the package is imported."""

    def seconds(*arguments: str) -> float:
        return median_seconds(lambda k: subprocess.run([sys.executable, *arguments], check=True, capture_output=True))

    return [
        at_most("uwlts --help", seconds("-m", "uwlts", "--help"), "s", 0.3),
        at_most("import uwlts", seconds("-c", "import uwlts") - seconds("-c", ""), "s", 0.2),
    ]


_ALL = (demo, reproduction, rendering, light, campaign, pipeline, studies, datasets, hardware, commands)
SECTIONS = {section.__name__: section for section in _ALL}


def main(*sections: str) -> int:
    """Measure, print a table after every section, write the result; exit code 1 if a limit is broken, 2 if misused."""
    chosen = sections or tuple(SECTIONS)
    if unknown := set(chosen) - set(SECTIONS):
        print(f"error: unknown section {', '.join(sorted(unknown))}; there are {', '.join(SECTIONS)}", file=sys.stderr)
        return 2
    if (count := len(os.sched_getaffinity(0))) > CORES:
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:CORES])
        print(f"{count} cores found, measuring on {CORES}")
    # Before the renderer is imported.
    use_variant()
    console, rows = Console(width=130), []
    for number, name in enumerate(chosen, 1):
        summary = (SECTIONS[name].__doc__ or "").partition(":")[0].rstrip(".\n")
        console.print(f"[{number}/{len(chosen)}] {name}: {summary}", markup=False)
        start = time.perf_counter()
        measured = SECTIONS[name]()
        rows += measured
        table = Table("what", "value", "limit", "unit", "", title=f"{name}, {time.perf_counter() - start:.0f} s")
        for row in measured:
            table.add_row(row.name, f"{row.value:.3f}", f"{row.limit:.4g}", row.unit, "ok" if row.ok else "MISSED")
        console.print(table)
    RESULT.parent.mkdir(parents=True, exist_ok=True)
    RESULT.write_text(json.dumps([asdict(row) for row in rows], indent=2) + "\n", encoding="utf-8")
    missed = sum(not row.ok for row in rows)
    print(f"{len(rows) - missed} of {len(rows)} limits kept; wrote {RESULT}")
    return 1 if missed else 0


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
