"""Errors of multiply scattered light: percentiles and spatial spectrum of frames against many more walks.

    python docs/studies/scattered_light.py frames coastal FILE.npz          # eight frames of two spheres, 16 samples
    python docs/studies/scattered_light.py reference coastal FILE.npz       # 600 walks per cell, without clean-up
    python docs/studies/scattered_light.py compare PICTURE.svg REFERENCE.npz[,MORE.npz] FRAMES.npz ...

The reference takes the plain means of random walks per cell, without the spreading of outliers; several references,
with ``--seed`` of their own, are averaged. Grey values are scaled to a stripe's peak of 200.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np

SEEDS = 8
SPP = 16
REFERENCE_WALKS = 600
PEAK_DN = 200.0
AWAY_PX = (0, 16, 32)


def render(kind: str, water: str, out: Path, *, seed: int) -> None:
    """Write the frames' scattered light (N, H, W), or the reference's cells, and the stripe to ``out``."""
    from tests.bench.light import in_named_water
    from twin.light.illumination import lights
    from twin.light.pose import SensorPose
    from twin.light.renderer import WALK_CELL_PX, Renderer
    from twin.light.walk import Walker
    from twin.options import use_variant
    from twin.scene.description import load_scene

    use_variant()
    sensor = in_named_water(water)
    renderer = Renderer(sensor, sensor.media["water"], load_scene("spheres"))
    count = SEEDS if kind == "frames" else 1
    frames = [renderer.laser_frame(np.eye(4), spp=SPP, seed=k) for k in range(count)]
    scattered = np.array([frame.scattered - frame.haze for frame in frames])
    if kind == "reference":
        pose = SensorPose(np.eye(4))
        direct, _ = lights(renderer._sheets, pose)
        walker = Walker(renderer.objects, renderer.scattering, renderer.effects, pose, direct, renderer._reach_mm)
        height, width = (size // WALK_CELL_PX for size in frames[0].scattered.shape)
        row, column = (g.ravel() for g in np.indices((height, width)))
        walked = renderer._walked(
            walker, row, column, np.full(row.size, WALK_CELL_PX), seed=90001 + seed, walks=REFERENCE_WALKS
        )
        scattered = walked.reshape(1, height, width)
    np.savez(out, scattered=scattered, direct=frames[0].direct())


def spectrum(errors: np.ndarray, side: int = 256) -> tuple[np.ndarray, np.ndarray]:
    """Radially averaged amplitude in grey levels over spatial frequency in 1/px of the upper corner's squares."""
    window = np.outer(np.hanning(side), np.hanning(side))
    power = (np.abs(np.fft.fft2(errors[:, :side, :side] * window)) ** 2).mean(axis=0) / (window**2).sum()
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(side), np.fft.fftfreq(side)))
    ring = np.round(frequency * side).astype(int)
    mean = np.bincount(ring.ravel(), power.ravel()) / np.bincount(ring.ravel())
    return np.arange(1, side // 2) / side, np.sqrt(mean[1 : side // 2])


def compare(picture: Path, references: list[Path], files: list[Path]) -> None:
    """Print the errors of frames against the mean of references, and draw their spectra."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    cells = np.mean([np.load(path)["scattered"][0] for path in references], axis=0)
    figure, axes = plt.subplots(figsize=(5.5, 3.5), layout="constrained")
    for path in files:
        data = np.load(path)
        scale = PEAK_DN / data["direct"].max()
        height, width = data["direct"].shape
        truth = cv2.resize((scale * cells).astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
        errors = scale * data["scattered"] - truth
        distance = cv2.distanceTransform((data["direct"] <= 0).astype(np.uint8), cv2.DIST_L2, 5)
        for px in AWAY_PX:
            away = distance > px
            some = np.abs(errors[:, away])
            bias = errors[:, away].mean() / truth[away].mean()
            print(
                f"{path.stem:24s} farther than {px:2d} px: 99.9th percentile {np.percentile(some, 99.9):.2f}, "
                f"largest {some.max():.1f}, rms {np.sqrt((some**2).mean()):.3f} DN, bias {100 * bias:+.1f} %"
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
        references, *files = arguments.files
        compare(Path(arguments.what), [Path(each) for each in references.split(",")], [Path(each) for each in files])
    else:
        render(arguments.kind, arguments.what, Path(arguments.files[0]), seed=arguments.seed)


if __name__ == "__main__":
    main()
