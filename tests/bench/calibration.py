"""Time of the joint calibration and of measuring with it, on the captures of a campaign of `tests.bench.light`."""

import os
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np

from tests.bench.rows import median_seconds
from tests.uwlts.mount_views import known_mount
from uwlts.calibration.calibrate import solve_jointly
from uwlts.calibration.joint.gathering import gather_jointly
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions
from uwlts.model.calibration import Calibration
from uwlts.model.trajectory import Trajectory
from uwlts.reconstruction.moving import add_platform_poses, add_platform_uncertainty, find_platform_poses
from uwlts.reconstruction.reconstruct import reconstruct_stripes
from uwlts.storage.capture import Capture
from uwlts.stripe import find_stripes

AS_OFTEN = 8
"""Repetitions of a scan's images along a trajectory: about a hundred images, as in scans by moving sensors."""


class _InMemory:
    """Capture with all images in memory, optionally repeated several times, one image per second."""

    def __init__(self, capture: Capture, times: int = 1):
        self.capture = capture
        self.path, self.header, self.pose = capture.path, capture.header, np.tile(capture.pose, (times, 1, 1))
        self.laser_on = np.tile(capture.laser_on, times)
        self.stage_mm, self.exposure_ms = np.tile(capture.stage_mm, times), np.tile(capture.exposure_ms, times)
        self.speed_mm_per_s, self.time_s = np.tile(capture.speed_mm_per_s, times), np.arange(times * len(capture)) * 1.0
        self._images = [capture.image(number) for number in range(len(capture))] * times

    def image(self, index: int) -> np.ndarray:
        return self._images[index]

    def __len__(self) -> int:
        return len(self._images)


def joint_calibration(targets: list[Path], steps: list[Path]) -> tuple[Calibration, int, float, float]:
    """Return the calibration, its number of images, and the seconds to find targets and stripes and of the estimate."""
    options = CalibrationOptions()
    with ExitStack() as stack:
        opened = [[stack.enter_context(Capture(path)) for path in paths] for paths in (targets, steps)]
        start = time.perf_counter()
        gathered = gather_jointly(*opened, options=options)
        found = time.perf_counter()
        calibration = solve_jointly(gathered, options=options).calibration
        images = sum(len(capture) for captures in opened for capture in captures)
        return calibration, images, found - start, time.perf_counter() - found


@contextmanager
def one_processor() -> Iterator[None]:
    """Restrict this thread, and the threads that it starts, to one processor."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(before)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def stripes_scaling(scan: Path) -> float:
    """Return the speed of finding the stripes of a scan's images in memory, relative to that of one processor."""
    with Capture(scan) as capture:
        images = _InMemory(capture, AS_OFTEN)
        with one_processor():
            alone = median_seconds(lambda k: find_stripes(images))
        return alone / median_seconds(lambda k: find_stripes(images))


def measuring_rate(scans: list[Path], calibration: Calibration) -> tuple[float, float]:
    """Return frames per second on one processor, from images in memory to points with covariance, after a first scan.

    The two values are medians over the scans: with the stage's positions, and with `AS_OFTEN` times as many images
    along a trajectory of known covariance with a mount.
    """
    mount = known_mount(np.eye(4), time_offset_s=0.0, time_offset_std_s=1e-4)
    with ExitStack() as stack:
        stack.enter_context(one_processor())
        opened = [stack.enter_context(Capture(path)) for path in scans]
        by_stage, by_path = [], []
        for images in [_InMemory(each) for each in opened] * 12:
            start = time.perf_counter()
            cloud = reconstruct_stripes(images.capture, find_stripes(images), calibration, with_uncertainty=True)
            assert cloud.uncertainty is not None and cloud.uncertainty.covariance_mm2().shape == (len(cloud), 3, 3)
            by_stage.append((time.perf_counter() - start) / np.count_nonzero(images.laser_on))
        for images in [_InMemory(each, AS_OFTEN) for each in opened] * 8:
            trajectory = _trajectory(images.time_s)
            start = time.perf_counter()
            ride = find_platform_poses(images, trajectory, mount=mount, clock_offset_s=0.0)
            table, stripes = add_platform_poses(images, ride, mount), find_stripes(images)
            cloud = reconstruct_stripes(table, stripes, calibration, with_uncertainty=True)
            assert cloud.uncertainty is not None
            known = add_platform_uncertainty(cloud.uncertainty, cloud.points_mm, cloud.frame, ride, mount)
            assert known.covariance_mm2().shape == (len(cloud), 3, 3)
            by_path.append((time.perf_counter() - start) / np.count_nonzero(images.laser_on))
        return 1.0 / float(np.median(by_stage[1:])), 1.0 / float(np.median(by_path[1:]))


def _trajectory(times_s: np.ndarray) -> Trajectory:
    """Return poses along X at 2 mm/s, one for three images, of a navigation with a drift of 0.3 m and 1 deg."""
    at = np.linspace(times_s[0], times_s[-1], len(times_s) // 3)
    poses = np.tile(np.eye(4), (len(at), 1, 1))
    poses[:, 0, 3] = 2.0 * at
    part = ((at - at[0]) / (at[-1] - at[0]))[:, None, None]
    return Trajectory(at, poses, part**2 * np.diag(np.square(np.repeat([300.0, np.radians(1.0)], 3))))
