"""Speed of making data sets."""

import tempfile
import time
from pathlib import Path

import twin

FEW, MANY = 32, 96
"""Scenes of two runs: the difference leaves out the start of the processes."""


def rate_hz(*, workers: int) -> float:
    """Frames per second of the preset `stripe-clean`."""
    with tempfile.TemporaryDirectory() as name:
        runs = [_made(Path(name, str(scenes)), scenes, workers) for scenes in (FEW, MANY)]
    seconds, frames = zip(*runs, strict=True)
    return (frames[1] - frames[0]) / (seconds[1] - seconds[0])


def _made(folder: Path, scenes: int, workers: int) -> tuple[float, int]:
    """Record ``scenes`` scenes; return the seconds taken and the number of frames."""
    start = time.perf_counter()
    twin.dataset("stripe-clean", out=folder, scenes=scenes, workers=workers)
    return time.perf_counter() - start, len(twin.load_dataset(folder))
