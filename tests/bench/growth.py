"""Growth of cost with frames, pixels, samples, points and evidence: ``python -m tests.bench.growth [--write]``.

Measures processor time over two decades of each, fits the exponents, and draws ``docs/pictures/growth.svg``. For short
runs, the fastest of several repetitions is used.
"""

import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from cyclopts import App

import uwlts
from docs.studies.result_tables import publish, table
from tests.uwlts.calibration_views import built_sensor
from tests.uwlts.joint_views import Noise, gathered, target_series
from twin.rendering_options import Options, use_variant
from twin.scene.description import load_scene
from uwlts.calibration.calibrate import solve_jointly
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions
from uwlts.model.library import load_sensor
from uwlts.model.sensor import CaptureHeader
from uwlts.pages.toolkit import new_figure
from uwlts.reconstruction.reconstruct import reconstruct_stripes
from uwlts.storage.capture import Capture, Frame
from uwlts.storage.capture_writer import CaptureWriter
from uwlts.storage.cloud import PointCloud
from uwlts.storage.cloud_files import read_cloud, write_cloud
from uwlts.stripe import extract_stripe, find_stripes

PICTURE = Path(__file__).resolve().parents[2] / "docs" / "pictures" / "growth.svg"
_AT_LEAST_S, _MOST_RUNS = 1.0, 5


@dataclass(frozen=True)
class Growth:
    """Processor time in s at each size, and the exponent of the line through both logarithms."""

    name: str
    unit: str
    sizes: list[int]
    seconds: list[float]

    def exponent(self, last: int = 0) -> float:
        """Return the slope of the logarithms, optionally of the ``last`` sizes only."""
        chosen = slice(-last, None) if last else slice(None)
        return float(np.polyfit(np.log(self.sizes[chosen]), np.log(self.seconds[chosen]), 1)[0])


def cost(action: Callable[[], object]) -> float:
    """Return the least processor time in s of an action, repeated until the total time can be measured."""
    seconds: list[float] = []
    while len(seconds) < _MOST_RUNS and sum(seconds) < _AT_LEAST_S:
        began = time.process_time()
        action()
        seconds.append(time.process_time() - began)
    return min(seconds)


def _stripe(height: int, width: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    centre = height * (0.5 + 0.2 * np.sin(np.linspace(0, 5, width)))
    image = 8 + 170 * np.exp(-0.5 * ((np.arange(height)[:, None] - centre) / 2) ** 2)
    return np.clip(rng.normal(image, 2), 0, 255).astype(np.uint8)


def frames(folder: Path) -> Growth:
    """Stripes and points of a capture on disk, by its frames of 1280 x 1024."""
    sensor, calibration = load_sensor("thesis"), uwlts.nominal("thesis", medium="water")
    medium = sensor.medium("water")
    header = CaptureHeader(
        name="growth",
        sensor=sensor,
        medium_name="water",
        medium=medium,
        stage_direction=(1.0, 0.0, 0.0),
        saturation_dn=255,
    )
    sizes, seconds = [8, 25, 80, 250, 800], []
    images = [_stripe(1024, 1280, k) for k in range(8)]
    for count in sizes:
        path = folder / f"{count}.h5"
        with CaptureWriter(path, header, dtype=np.dtype(np.uint8)) as writer:
            for k in range(count):
                writer.append(Frame(images[k % 8], 0.1 * k, True, 1.0, float(k)))
        with Capture(path) as capture:
            seconds.append(cost(lambda: reconstruct_stripes(capture, find_stripes(capture), calibration)))
        path.unlink()
    return Growth("stripes and points of a capture", "frames", sizes, seconds)


def image_size() -> Growth:
    """Stripe extraction by the pixels of an image."""
    shapes = [(128, 160), (224, 288), (400, 512), (720, 900), (1280, 1600)]
    seconds = [cost(lambda at=at: extract_stripe(_images[at], stripe_along="width")) for at in shapes]
    return Growth("stripe of an image", "pixels", [h * w for h, w in shapes], seconds)


_images = {at: _stripe(*at, seed=1) for at in [(128, 160), (224, 288), (400, 512), (720, 900), (1280, 1600)]}


def samples() -> Growth:
    """The laser's light in a frame of two spheres in clear water, by samples per lit pixel."""
    use_variant()
    from twin.recording.sensor_simulator import SensorSimulator

    studio = SensorSimulator(load_sensor("thesis"), load_scene("spheres", water="clear"), Options(), probe="middle")
    shot = list(studio.scene.motion.shots())[19]
    sizes = [4, 12, 40, 120, 400]
    return Growth(
        "light of a rendered frame",
        "samples per pixel",
        sizes,
        [cost(lambda spp=spp: studio.electrons_per_ms(shot, spp=spp, seed=1)) for spp in sizes],
    )


def points(folder: Path) -> Iterator[Growth]:
    """Evaluation of a plane, and a cloud written and read, by points."""
    rng, sizes = np.random.default_rng(3), [3_000, 10_000, 30_000, 100_000, 300_000]
    evaluated, stored = [], []
    for count in sizes:
        places = rng.uniform(-50, 50, (count, 3)) * (1, 1, 0) + rng.normal(0, 0.02, (count, 3))
        number = np.arange(count)
        cloud = PointCloud(places, np.ones(count, np.float32), number // 1000, number % 1000)
        evaluated.append(cost(lambda cloud=cloud: uwlts.evaluate(cloud, artefact={"kind": "plane"})))
        path = folder / "cloud.ply"

        def there_and_back(cloud: PointCloud = cloud, path: Path = path) -> None:
            write_cloud(path, cloud, overwrite=True)
            read_cloud(path)

        stored.append(cost(there_and_back))
    yield Growth("evaluation of a plane", "points", sizes, evaluated)
    yield Growth("cloud to PLY and back", "points", sizes, stored)


def evidence() -> Growth:
    """Joint calibration by images of a target with 81 points and a stripe, half of them in air and half in water."""
    sensor, sizes, seconds = built_sensor(), [8, 24, 80, 240, 800], []
    options = CalibrationOptions(poses="stage", correct_circles=False)
    for count in sizes:
        noise = Noise(circles_px=0.03, stripe_px=0.1, stage_mm=0.003, rng=np.random.default_rng(4))
        places = np.linspace(-120, 60, count // 2)
        views = {"positions": places, "noise": noise, "columns": 9}
        series = [target_series(sensor, medium=medium, **views) for medium in (None, 0)]
        made = gathered(load_sensor("thesis"), series)
        seconds.append(cost(lambda made=made: solve_jointly(made, options=options)))
    return Growth("joint calibration", "evidence images", sizes, seconds)


def draw(found: list[Growth], path: Path) -> None:
    """Cost over size, both logarithmic, with the exponents."""
    figure, axes = new_figure(8.4, 5.2, rows=2, columns=3)
    for ax, growth in zip(axes, found, strict=True):
        ax.loglog(growth.sizes, growth.seconds, "o-")
        first, last = growth.sizes[0], growth.sizes[-1]
        ax.loglog([first, last], growth.seconds[-1] * np.array([first / last, 1]), ":", color="grey", label="linear")
        title = f"{growth.name}\nexponent {growth.exponent():.2f}, at the end {growth.exponent(2):.2f}"
        ax.set_title(title, fontsize=8)
        ax.set(xlabel=growth.unit, ylabel="processor time / s")
        ax.legend(fontsize=7, frameon=False)
    figure.tight_layout()
    path.parent.mkdir(exist_ok=True)
    figure.savefig(path)


def measured(folder: Path) -> Iterator[Growth]:
    """All of them, one after the other."""
    yield frames(folder)
    yield image_size()
    yield from points(folder)
    yield samples()
    yield evidence()


def main(*, write: bool = False) -> None:
    """Measure and print; with `--write`, put the table into its page and draw the picture."""
    found, rows = [], []
    with tempfile.TemporaryDirectory() as name:
        for growth in measured(Path(name)):
            found.append(growth)
            sizes = zip(growth.sizes, growth.seconds, strict=True)
            values = ", ".join(f"{size:,}: {1e3 * seconds:.4g} ms" for size, seconds in sizes)
            print(f"{growth.name} by {growth.unit}: {values}", flush=True)
            rows.append([growth.name, growth.unit, f"{growth.exponent(2):.2f}"])
    publish({"growth": table(["what", "by", "exponent"], rows)}, write=write)
    if write:
        draw(found, PICTURE)


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
