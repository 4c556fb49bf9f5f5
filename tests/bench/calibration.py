"""Time of the joint calibration and of measuring with it, on the captures of a campaign of `tests.bench.light`."""

import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from uwlts.calibration.joint.gathering import gather_jointly
from uwlts.calibration.joint.procedure import solve_jointly
from uwlts.calibration.sequential import CalibrationOptions
from uwlts.measurement.reconstruction import reconstruct_stripes
from uwlts.model.calibration import Calibration
from uwlts.model.sensor import CaptureHeader
from uwlts.storage.capture import Capture
from uwlts.stripe import find_stripes


@dataclass(frozen=True)
class _InMemory:
    """The laser images of a capture, read beforehand."""

    path: Path
    header: CaptureHeader
    images: list[tuple[int, np.ndarray]]

    def frames(self, *, laser_on: bool | None = None) -> Iterator[tuple[int, np.ndarray]]:
        return iter(self.images)

    def __len__(self) -> int:
        return len(self.images)


def joint_calibration(targets: list[Path], steps: list[Path]) -> tuple[Calibration, float, float]:
    """The calibration, the seconds to find targets and stripes in all images, and those of the estimate."""
    options = CalibrationOptions()
    with ExitStack() as stack:
        opened = [[stack.enter_context(Capture(path)) for path in paths] for paths in (targets, steps)]
        start = time.perf_counter()
        gathered = gather_jointly(*opened, options=options)
        found = time.perf_counter()
        calibration = solve_jointly(gathered, options=options).calibration
        return calibration, found - start, time.perf_counter() - found


def measuring_rate(scan: Path, calibration: Calibration) -> float:
    """Frames per second from images in memory to points with their covariance."""
    with Capture(scan) as capture:
        images = _InMemory(scan, capture.header, [(k, image.copy()) for k, image in capture.frames(laser_on=True)])
        seconds = []
        for _ in range(4):
            start = time.perf_counter()
            cloud = reconstruct_stripes(capture, find_stripes(images), calibration, with_uncertainty=True)
            assert cloud.uncertainty is not None and cloud.uncertainty.covariance_mm2().shape == (len(cloud), 3, 3)
            seconds.append(time.perf_counter() - start)
        return len(images) / float(np.median(seconds[1:]))
