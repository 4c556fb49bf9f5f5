"""Speed of making data sets."""

import resource
import tempfile
import time
from pathlib import Path

import numpy as np

import twin

FEW, MANY = 32, 96
"""Scenes of two runs: the difference leaves out the start of the processes."""


def measure_frames(*, workers: int) -> tuple[float, float]:
    """Return frames per second of the preset `stripe-clean`, and the processor time of a frame in s."""
    with tempfile.TemporaryDirectory() as name:
        # One worker renders in this process, whose first frame takes seconds more than later ones.
        _make(Path(name, "first"), 1, workers)
        few, many = (_make(Path(name, str(scenes)), scenes, workers) for scenes in (FEW, MANY))
    seconds, processor_s, frames = np.subtract(many, few)
    return frames / seconds, processor_s / frames


def _make(folder: Path, scenes: int, workers: int) -> tuple[float, float, int]:
    """Record ``scenes`` scenes; return the time taken and the processor time in s, and the number of frames."""
    start = time.perf_counter(), _processor_s()
    twin.dataset("stripe-clean", out=folder, scenes=scenes, workers=workers)
    return time.perf_counter() - start[0], _processor_s() - start[1], len(twin.load_dataset(folder))


def _processor_s() -> float:
    """Return the processor time of this process and its ended children in s."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)
