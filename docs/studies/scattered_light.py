"""Errors of multiply scattered light: percentiles and spatial spectrum of frames against many more walks.

    python docs/studies/scattered_light.py frames coastal FILE.npz          # frames of two spheres, 16 samples
    python docs/studies/scattered_light.py reference coastal FILE.npz       # plain means of many walks per cell
    python docs/studies/scattered_light.py compare PICTURE.svg REFERENCE.npz,FRAMES.npz[,MORE.npz] ...

The reference is the plain mean of 4,800 random walks per cell, or 64,800 within 48 px of the stripe. It takes about
4 min of processor time; `tests/data/scattered-WATER.npz` are examples. Grey values are scaled to a stripe's peak of
200.
"""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from twin.light.renderer import Renderer

SEEDS = 16
SPP = 16
PARTS, WALKS, MORE_WALKS, NEAR_PX = 12, 400, 5000, 48
"""Number of parts of the reference, random walks per cell and part, and more of them within NEAR_PX of the stripe.

The scatter of the parts gives the error of the reference.
"""
PEAK_DN = 200.0
AWAY_PX = (0, 16, 32)


def render(kind: str, water: str, out: Path, *, seed: int) -> None:
    """Write the scattered light of frames (N, H, W) and the stripe, or the cells of a reference and their error."""
    from tests.bench.light import in_named_water
    from twin.light.renderer import Renderer
    from twin.rendering_options import use_variant
    from twin.scene.description import load_scene

    use_variant()
    sensor = in_named_water(water)
    renderer = Renderer(sensor, sensor.media["water"], load_scene("spheres"))
    count = SEEDS if kind == "frames" else 1
    frames = [renderer.laser_frame(np.eye(4), spp=SPP, seed=seed + k) for k in range(count)]
    direct = frames[0].direct()
    if kind == "frames":
        np.savez(out, scattered=np.array([frame.scattered - frame.haze for frame in frames]), direct=direct)
    else:
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


def compare(picture: Path, groups: list[list[Path]]) -> None:
    """Print the errors of frames against the reference, the first file of each group, and draw their spectra."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(5.5, 3.5), layout="constrained")
    for cells, *files in groups:
        for path in files:
            data = np.load(path)
            scale = PEAK_DN / data["direct"].max()
            height, width = data["direct"].shape
            truth = cv2.resize(scale * np.load(cells)["scattered"], (width, height), interpolation=cv2.INTER_LINEAR)
            errors = scale * data["scattered"] - truth
            distance = away_from(data["direct"])
            for px in AWAY_PX:
                away = distance > px
                some = np.abs(errors[:, away])
                means = errors[:, away].mean(axis=1) / truth[away].mean()
                print(
                    f"{path.stem:24s} farther than {px:2d} px: 99.9th percentile {np.percentile(some, 99.9):.2f}, "
                    f"largest {some.max():.2f}, rms {np.sqrt((some**2).mean()):.3f} DN, "
                    f"mean {100 * means.mean():+.2f} +/- {100 * means.std(ddof=1) / np.sqrt(len(means)):.2f} %"
                )
            axes.loglog(*spectrum(errors), label=path.stem)
    axes.set(xlabel="spatial frequency in 1/px", ylabel="amplitude of the error in DN")
    axes.legend()
    figure.savefig(picture)


def main() -> None:
    """Render or compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=("frames", "reference", "compare"))
    parser.add_argument("what", help="a named water, or the picture to draw")
    parser.add_argument("files", nargs="+")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    if arguments.kind == "compare":
        compare(Path(arguments.what), [[Path(each) for each in group.split(",")] for group in arguments.files])
    else:
        render(arguments.kind, arguments.what, Path(arguments.files[0]), seed=arguments.seed)


if __name__ == "__main__":
    main()
