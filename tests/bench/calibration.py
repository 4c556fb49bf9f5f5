"""Time of the joint calibration and of measuring with it, on the captures of a campaign of `tests.bench.light`."""

import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from uwlts.calibration.joint.gathering import gather_jointly
from uwlts.calibration.joint.procedure import solve_jointly
from uwlts.calibration.sequential import CalibrationOptions
from uwlts.measurement.reconstruction import reconstruct_stripes
from uwlts.model.calibration import Calibration
from uwlts.storage.capture import Capture
from uwlts.stripe import find_stripes


class _InMemory:
    """A capture whose images were read beforehand."""

    def __init__(self, capture: Capture):
        self.capture = capture
        self.path, self.header, self.laser_on, self.pose = capture.path, capture.header, capture.laser_on, capture.pose
        self.stage_mm, self.exposure_ms = capture.stage_mm, capture.exposure_ms
        self.has_image = capture.has_image
        self._images = [capture.image(number) for number in range(len(capture))]

    def seen(self, index: int) -> np.ndarray:
        return self._images[index]

    def image(self, index: int) -> np.ndarray:
        return self._images[index]

    def __len__(self) -> int:
        return len(self._images)


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


def measuring_rate(scans: list[Path], calibration: Calibration) -> float:
    """Frames per second from images in memory to points with their covariance, of scans that follow a first one.

    The median over scans that are measured in turn.
    """
    with ExitStack() as stack:
        recordings = [_InMemory(stack.enter_context(Capture(path))) for path in scans]
        seconds = []
        for images in recordings * 12:
            start = time.perf_counter()
            cloud = reconstruct_stripes(images.capture, find_stripes(images), calibration, with_uncertainty=True)
            assert cloud.uncertainty is not None and cloud.uncertainty.covariance_mm2().shape == (len(cloud), 3, 3)
            seconds.append((time.perf_counter() - start) / np.count_nonzero(images.laser_on))
        return 1.0 / float(np.median(seconds[1:]))
