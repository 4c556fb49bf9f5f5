"""Compare speed and memory with the project's limits: ``python -m tests.bench``; writes ``runs/bench.json``.

    python -m tests.bench --runs 3 --write

With names of sections as arguments, only these are measured. Times are medians after a warm-up, without compilation.
Limits are for two cores. Most rows also state the ratio of their time to a floor: a plain computation on the same data,
measured in the same run (`tests.bench.floors`). Ratios hold on other machines, times do not. ``--runs`` repeats all
sections in turn, and states the median and range of each row. ``--write`` puts the table into docs/results/speed.md.
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, replace
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

from docs.studies import result_tables
from tests.bench.rows import Floor, Row, at_least, at_most, median_row, median_seconds
from twin.rendering_options import use_variant

RESULT = Path("runs/bench.json")
CORES = 2
STOCK_FRAME = "Mitsuba's path integrator, a frame without water"
MAXIMA = "NumPy's maximum of every line"
FIRST_IMAGE = """
import time

from tests.bench.recording import example_image
from uwlts.stripe import extract_stripe

image = example_image()
start = time.perf_counter()
extract_stripe(image, stripe_along="width")
print(time.perf_counter() - start)
"""


def rendering() -> list[Row]:
    """Time of sharp full-size laser frames of the thesis's sensor."""
    from tests.bench.floors import stock_frame_seconds
    from twin.light.renderer import Renderer
    from twin.rendering_options import NONE
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
    limit, floor = 0.25, Floor(STOCK_FRAME, stock_frame_seconds(), 0.5)
    return [
        at_most(
            "sharp laser frame 1280 x 1024, 64 samples per lit pixel, spheres in water",
            median_seconds(lambda k: spheres.laser_frame(pose(k), spp=64).irradiance()),
            "s",
            limit,
            floor,
        ),
        at_most(
            "sharp laser frame 1280 x 1024, 64 samples per lit pixel, pipe across the whole image in water",
            median_seconds(lambda k: pipe.laser_frame(pose(k), spp=64).irradiance()),
            "s",
            limit,
            floor,
        ),
    ]


def light() -> list[Row]:
    """Time and noise of frames with all effects at the default samples, and the advantage over stock Mitsuba.

    The limits of the light alone were set for the noise of 64 samples in an earlier version.
    """
    from tests.bench import light as bench_light
    from tests.bench.floors import stock_frame_seconds

    rows, floor = [], Floor(STOCK_FRAME, stock_frame_seconds(), 1.0)
    for water, limit, most_light_s, most_noise in (("clear", 0.06, 0.12, 0.25), ("coastal", 0.1, 0.25, 0.66)):
        seconds, noise = bench_light.rendered_light(water)
        recorded, processor_s = bench_light.recorded_frame(water)
        of_frame = f"laser frame with all effects, speckle to disk, spheres in {water} water"
        of_light = f"the same: its light alone, before speckle and detector, {water} water"
        rows.append(at_most(of_frame, recorded, "s", limit, floor))
        rows.append(at_most(f"the same: processor time, {water} water", processor_s, "s", CORES * limit))
        rows.append(at_most(of_light, seconds, "s", most_light_s, floor))
        rows.append(at_most(f"the same: noise of its light, {water} water", 100 * noise, "% of peak", most_noise))
    advantage, how = bench_light.equal_noise_advantage()
    rows.append(at_least(f"advantage over volpath at equal noise ({how})", advantage, "times", 1000))
    return rows


def campaign() -> list[Row]:
    """Speed of a campaign of the thesis: record it, calibrate jointly from it, and measure with it on one core."""
    from tests.bench.calibration import joint_calibration, measuring_rate, stripes_scaling
    from tests.bench.floors import connected_parts_seconds, line_maxima_seconds, stock_frame_seconds
    from tests.bench.light import campaign as recorded
    from uwlts.storage.capture import Capture

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        frames, seconds, peak, growth = recorded(folder)
        target, *steps, in_water = (folder / f"{number}.h5" for number in range(5))
        calibration, images, finding, estimating = joint_calibration([target, in_water], steps)
        cv2.setNumThreads(1)
        by_stage, by_path = measuring_rate([folder / "13.h5", folder / "14.h5"], calibration)
        scaling = stripes_scaling(folder / "13.h5")
        with Capture(target) as capture:
            labelled = connected_parts_seconds(capture.image(0))
        with Capture(folder / "13.h5") as capture:
            maxima = line_maxima_seconds(capture.image(0), capture.header.sensor.camera.stripe_along)
    of_frames, of_lines = Floor(STOCK_FRAME, frames * stock_frame_seconds(), 1.0), Floor(MAXIMA, 1.0 / maxima, 40.0)
    of_images = Floor("OpenCV's connected components of as many images", images * labelled, 30.0)
    return [
        at_most(f"campaign of {frames} frames", seconds, "s", 60, of_frames),
        at_most("campaign, peak memory", peak, "GiB", 3),
        at_most("campaign, time of the last frames over that of earlier ones", growth, "times", 1.3),
        at_most(f"joint calibration: targets and stripes found in its {images} images", finding, "s", 3, of_images),
        at_most("joint calibration: the estimate", estimating, "s", 3),
        at_least("spheres in water: stripes, points and their covariance", by_stage, "frames/s", 1000, of_lines),
        at_least("the same along a trajectory", by_path, "frames/s", 1000, of_lines),
        at_least(f"stripes of a scan: speed of {CORES} processors relative to one", scaling, "times", 1.9),
    ]


def pipeline() -> list[Row]:
    """Processor time of stripe extraction and reconstruction: the default method, and the fastest one."""
    from tests.bench.floors import connected_parts_seconds, line_maxima_seconds, plain_centroid_seconds
    from twin.recording.sensor_simulator import SensorSimulator
    from twin.rendering_options import Options
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
        image = SensorSimulator(sensor, scene, Options()).frame(shots[len(shots) // 2], 0).image
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
        measure = partial(median_seconds, runs=101, clock=time.process_time)
        extraction = measure(lambda k, extract=extract: extract())
        both = measure(lambda k, extract=extract, then=reconstruct: then(extract().pixels()))
        maxima = Floor(MAXIMA, 1e3 * line_maxima_seconds(image, along), 6.0)
        plain = plain_centroid_seconds(image, along)
        if method == default:
            rows.append(at_most(f"a plain compiled centroid, {stripe}", 1e3 * plain, "ms/frame", limit_ms, maxima))
        centroid = Floor("a plain compiled centroid", 1.0 / plain, 20.0)
        rows.append(at_most(f"{method}, {stripe}", 1e3 * extraction, "ms/frame", limit_ms, maxima))
        rows.append(
            at_least(f"{method} and reconstruction on one core, {stripe}", 1 / both, "frames/s", 1000, centroid)
        )
    scene = load_scene("target")
    target = parse_target(scene.target)
    lamp = next(shot for shot in scene.motion.shots() if shot.light == "lamp")
    image = SensorSimulator(load_sensor("thesis"), scene, Options()).frame(lamp, 0).image
    seconds = median_seconds(lambda k: target.detect(image), runs=11)
    found = len(target.detect(image).pixels)
    labelled = Floor("OpenCV's connected components of the image", connected_parts_seconds(image), 30.0)
    return [*rows, at_most(f"the {found} circles of a target in view found, on one core", seconds, "s", 0.3, labelled)]


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
    from tests.bench.dataset import measure_frames
    from tests.bench.floors import stock_frame_seconds

    (one, processor_s), (two, _) = (measure_frames(workers=workers) for workers in (1, 2))
    # A frame of 640 x 512 pixels has a quarter of the sensor's.
    stock = Floor(f"{STOCK_FRAME}, of 640 x 512", 4.0 / stock_frame_seconds(), 1.0)
    return [
        at_least("data set stripe-clean, two workers", two, "frames/s", 25, stock),
        at_least("the same: two workers by one", two / one, "times", 1.8),
        at_most("the same: processor time of a frame", processor_s, "s", CORES / 25),
    ]


def sensors() -> list[Row]:
    """Cost of large image sensors: processor time per lit pixel relative to 1280 x 1024, and memory."""
    from tests.bench.large_sensors import FINER, WORK, sensor_cost

    small, rows = sensor_cost(1), []
    for name, finer in FINER.items():
        large = sensor_cost(finer)
        for of, what in WORK.items():
            times = large.per_lit_pixel(of, small)
            rows.append(at_most(f"{name}, a frame {what} per lit pixel, by that of 1.3 Mpx", times, "times", 1.3))
        rows.append(at_most(f"{name}: peak memory", large.peak_gb, "GB", 4))
    return rows


def live() -> list[Row]:
    """Rate of rendered frames of 640 x 512 pixels while the stage moves, as `twin serve` shows them."""
    from tests.bench.live import LESS_LIGHT, frame_rate

    return [
        at_least("frames of 640 x 512 while the stage moves, all effects", frame_rate(), "frames/s", 30),
        at_least(f"the same without {' and '.join(LESS_LIGHT)}", frame_rate(*LESS_LIGHT), "frames/s", 30),
    ]


def hardware() -> list[Row]:
    """Frames per second from a camera to the disk, alone and with stripe and points found meanwhile."""
    from tests.bench.floors import plain_centroid_seconds, stored_image_seconds
    from tests.bench.recording import RATE_HZ, SERVED, TAKEN, example_image, following_rate, gige_recording, recording

    alone, live, gige = recording(), recording(live=True), gige_recording()
    image = example_image()
    centroid = Floor("a plain compiled centroid", 1.0 / plain_centroid_seconds(image, "width"), 60.0)
    return [
        at_most("camera to disk: HDF5 alone stores a frame", 1e3 * stored_image_seconds(image), "ms", 1e3 / RATE_HZ),
        at_least(f"camera to disk, {TAKEN} frames at {RATE_HZ:g}/s", alone.rate_hz, "frames/s", 0.99 * RATE_HZ),
        at_most("the same: lost", alone.lost, "frames", 0),
        at_least("the same while another process follows the file", live.rate_hz, "frames/s", 0.99 * RATE_HZ),
        at_most("the same: lost", live.lost, "frames", 0),
        at_least("the follower, with stripe and points", live.followed_hz, "frames/s", 0.99 * RATE_HZ),
        at_least("the follower: frames", live.followed, "frames", TAKEN),
        at_most("the follower: behind at the end", live.behind_s, "s", 0.25),
        at_least("the follower's work on frames from memory", following_rate(), "frames/s", 300, centroid),
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

    started = seconds("-c", "")
    python, numpy = Floor("an empty Python", started, 20.0), Floor("import numpy", seconds("-c", "import numpy"), 1.0)
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {"NUMBA_CACHE_DIR": folder, "PYTHONPATH": str(Path.cwd())}
        first, later = (
            float(subprocess.check_output([sys.executable, "-c", FIRST_IMAGE], env=environment)) for _ in range(2)
        )
    return [
        at_most("uwlts --help", seconds("-m", "uwlts", "--help"), "s", 0.3, python),
        at_most("import uwlts, beyond an empty Python", seconds("-c", "import uwlts") - started, "s", 0.2, numpy),
        at_most("the stripe of the first image, nothing compiled yet", first, "s", 3),
        at_most("the stripe of the first image of a later process", later, "s", 0.5),
    ]


_ALL = (demo, rendering, light, campaign, pipeline, studies, datasets, sensors, live, hardware, commands)
SECTIONS = {section.__name__: section for section in _ALL}


def main(*sections: str, runs: int = 1, write: bool = False) -> int:
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
    if runs % 2 == 0:
        print(f"error: {runs} runs have no median that was measured; give an odd number", file=sys.stderr)
        return 2
    firsts: list[int] = []
    repeated = []
    for _ in range(runs):
        found: list[Row] = []
        for name in chosen:
            firsts.append(len(found))
            found += _measure(name)
        repeated.append(found)
    rows = repeated[0] if runs == 1 else [median_row(same) for same in zip(*repeated, strict=True)]
    RESULT.parent.mkdir(parents=True, exist_ok=True)
    RESULT.write_text(json.dumps([asdict(row) for row in rows], indent=2) + "\n", encoding="utf-8")
    if write:
        # All rows would be a page; the others are in the file.
        shown = [row for number, row in enumerate(rows) if number in firsts or not row.ok]
        result_tables.publish({"speed": _as_markdown(shown)}, write=True)
    missed = sum(not row.ok for row in rows)
    print(f"{len(rows) - missed} of {len(rows)} limits kept; wrote {RESULT}")
    return 1 if missed else 0


def _measure(name: str) -> list[Row]:
    """Measure a section and print its rows."""
    console, section = Console(width=170), SECTIONS[name]
    summary = (section.__doc__ or "").partition(":")[0].rstrip(".\n")
    console.print(f"{name}: {summary}", markup=False)
    start = time.perf_counter()
    rows = section()
    head = "what", "value", "limit", "unit", "times floor", "limit", ""
    table = Table(*head, title=f"{name}, {time.perf_counter() - start:.0f} s")
    for row in rows:
        ratio = ("", "") if row.floor is None else (f"{row.ratio:.2f}", f"{row.floor.most:g}: {row.floor.name}")
        verdict = "ok" if row.ok else "MISSED"
        table.add_row(row.name, f"{row.value:.3f}", f"{row.limit:.4g}", row.unit, *ratio, verdict)
    console.print(table)
    return rows


def _as_markdown(rows: list[Row]) -> str:
    """Return the rows as a table with medians."""
    cells = []
    for row in rows:
        numbers = f"{_figures(row.value)} {row.unit}", f"{row.limit:,g}"
        ratio = "" if row.floor is None else f"{row.ratio:.3g} ({row.floor.most:g})"
        cells.append([row.name, *numbers, ratio, "" if row.ok else "missed"])
    return result_tables.table(["what", "median", "limit", "times a plain computation (limit)", ""], cells)


def _figures(value: float) -> str:
    """Return a value with three figures, and at least its integer part."""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
