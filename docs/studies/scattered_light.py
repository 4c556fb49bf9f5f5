"""Errors of multiply scattered light: percentiles and spatial spectrum of frames against many more walks.

    python docs/studies/scattered_light.py [--write]                # 16 frames of two spheres, 16 samples, two waters
    python docs/studies/scattered_light.py reference coastal FILE.npz   # plain means of many walks per cell

The reference is the plain mean of 4,800 random walks per cell, or 64,800 within 48 px of the stripe. It takes about
4 min of processor time; those of the table are `tests/data/scattered-WATER.npz`. Grey values are scaled to a stripe's
peak of 200.
"""

from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from cyclopts import App
from result_tables import publish, table

if TYPE_CHECKING:
    from twin.light.renderer import Renderer

SEEDS = 16
SPP = 16
PARTS, WALKS, MORE_WALKS, NEAR_PX = 12, 400, 5000, 48
"""Number of parts of the reference, random walks per cell and part, and more of them within NEAR_PX of the stripe.

The scatter of the parts gives the error of the reference.
"""
PEAK_DN = 200.0
AWAY_PX = (0, 32)
WATERS = "coastal", "harbour"
DOCS = Path(__file__).resolve().parents[1]


def make_renderer(water: str) -> "Renderer":
    """Return the renderer of two spheres in a named water."""
    from twin.rendering_options import use_variant

    use_variant()  # before Dr.Jit is imported, because it prepares libLLVM
    from tests.bench.light import in_named_water
    from twin.light.renderer import Renderer
    from twin.scene.description import load_scene

    sensor = in_named_water(water)
    return Renderer(sensor, sensor.media["water"], load_scene("spheres"))


def write_reference(water: str, out: Path, *, seed: int = 0) -> None:
    """Write the cells of a reference and their error."""
    renderer = make_renderer(water)
    direct = renderer.laser_frame(np.eye(4), spp=SPP, seed=seed).direct()
    means = np.array([reference(renderer, away_from(direct), seed=90001 + 977 * (seed + k)) for k in range(PARTS)])
    error = means.std(axis=0, ddof=1) / np.sqrt(PARTS)
    np.savez_compressed(out, scattered=means.mean(axis=0).astype(np.float32), error=error.astype(np.float16))


def reference(renderer: "Renderer", distance: np.ndarray, *, seed: int) -> np.ndarray:
    """Return means (rows, columns) of random walks per cell, for an image (H, W) of distances from the stripe."""
    import twin.light.multiple_scattering as ways
    from twin.light.illumination import make_lights
    from twin.light.pose import SensorPose
    from twin.light.walk import Walker

    pose, side = SensorPose(np.eye(4)), ways.WALK_CELL_PX
    direct, _ = make_lights(renderer._sheets, pose)
    walker = Walker(renderer.objects, renderer.scattering, renderer.effects, pose, direct, renderer._reach_mm)
    rows, columns = (size // side for size in distance.shape)
    nearest = distance.reshape(rows, side, columns, side).min(axis=(1, 3)).ravel()
    total, count = np.zeros((2, rows * columns))
    for cells, walks in ((np.arange(nearest.size), WALKS), (np.flatnonzero(nearest <= NEAR_PX), MORE_WALKS)):
        place = cells // columns * side, cells % columns * side, np.full(len(cells), side)
        for cell, *light in ways.trace_walks(renderer.view, walker, *place, seed=seed, walks=walks):
            total += np.bincount(cells[cell], sum(light), rows * columns)
        count[cells] += walks
        seed += 500_000
    return (total / count).reshape(rows, columns)


def away_from(direct: np.ndarray) -> np.ndarray:
    """Distance (H, W) in px from the stripe's pixels."""
    return cv2.distanceTransform((direct <= 0).astype(np.uint8), cv2.DIST_L2, 5)


def spectrum(errors: np.ndarray, side: int = 256) -> tuple[np.ndarray, np.ndarray]:
    """Return the radially averaged amplitude in grey levels by spatial frequency in 1/px, of the upper corner."""
    window = np.outer(np.hanning(side), np.hanning(side))
    power = (np.abs(np.fft.fft2(errors[:, :side, :side] * window)) ** 2).mean(axis=0) / (window**2).sum()
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(side), np.fft.fftfreq(side)))
    ring = np.round(frequency * side).astype(int)
    mean = np.bincount(ring.ravel(), power.ravel()) / np.bincount(ring.ravel())
    return np.arange(1, side // 2) / side, np.sqrt(mean[1 : side // 2])


def main(*, write: bool = False) -> None:
    """Print the table; with `--write`, put it into its page, and draw the spectra."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(5.5, 3.5), layout="constrained")
    rows = []
    for water in WATERS:
        renderer = make_renderer(water)
        frames = [renderer.laser_frame(np.eye(4), spp=SPP, seed=seed) for seed in range(SEEDS)]
        direct, scattered = frames[0].direct(), np.array([frame.scattered - frame.haze for frame in frames])
        scale, (height, width) = PEAK_DN / direct.max(), direct.shape
        cells = np.load(DOCS.parent / "tests" / "data" / f"scattered-{water}.npz")["scattered"]
        truth = cv2.resize(scale * cells, (width, height), interpolation=cv2.INTER_LINEAR)
        errors, distance = scale * scattered - truth, away_from(direct)
        for px in AWAY_PX:
            away = distance > px
            some = np.abs(errors[:, away])
            means = 100 * errors[:, away].mean(axis=1) / truth[away].mean()
            name = f"{water}, farther than {px} px from the stripe" if px else water
            sizes = f"{np.percentile(some, 99.9):.2f}", f"{some.max():.1f}", f"{np.sqrt((some**2).mean()):.3f}"
            rows.append([name, *sizes, f"{means.mean():+.1f} ± {means.std(ddof=1) / np.sqrt(len(means)):.1f} %"])
        axes.loglog(*spectrum(errors), label=water)
    head = ["water", "99.9th percentile", "largest", "rms", "mean against the reference"]
    publish({"scattered light": table(head, rows)}, write=write)
    axes.set(xlabel="spatial frequency in 1/px", ylabel="amplitude of the error in DN")
    axes.legend()
    if write:
        figure.savefig(DOCS / "pictures" / "scattered-light.svg")


if __name__ == "__main__":
    app = App(help=__doc__, help_format="plaintext", default_command=main)
    app.command(write_reference, name="reference")
    app()
