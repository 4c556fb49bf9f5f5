"""Recording of a long ride on a vehicle, with path, mount and covariance, and the cost of a command on it."""

import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from tests.uwlts.drawn_stripes import draw_centres
from tests.uwlts.mount_views import known_mount
from uwlts.model.library import load_sensor
from uwlts.model.sensor import CaptureHeader
from uwlts.model.trajectory import Trajectory
from uwlts.recalibration.as_built import as_built
from uwlts.storage.capture import Frame
from uwlts.storage.capture_writer import CaptureWriter

RATE_HZ, SPEED_MM_PER_S, NOISE_PX = 200.0, 100.0, 0.1
"""Of the images, of the vehicle, and of the stripe centres."""
RECONSTRUCT = (
    "uwlts reconstruct ride.h5 --calibration calibration.json --mount mount.json --trajectory path.csv "
    "--pose-format quaternion-xyzw --out ride.cloud.h5"
)
_DIFFERENT = 50  # images that are written one by one; further ones are copies


@dataclass(frozen=True)
class Cost:
    """Cost of a command, and the most memory that it may take."""

    command: str
    seconds: float
    processor_s: float
    peak_gb: float
    limit_gb: float


def write_ride(folder: Path, frames: int) -> None:
    """Write capture, joint calibration, mount and trajectory of a ride, for `RECONSTRUCT`."""
    sensor, rng = load_sensor("thesis-small"), np.random.default_rng(65)
    water, camera = sensor.media["water"], sensor.camera
    header = CaptureHeader(
        name="ride",
        sensor=sensor,
        medium_name="water",
        medium=water,
        stage_direction=(1.0, 0.0, 0.0),
        saturation_dn=255,
    )
    as_built(sensor, water).save(folder / "calibration.json")
    known_mount(np.eye(4), time_offset_s=0.0, time_offset_std_s=1e-4).save(folder / "mount.json")
    lines, length = camera.lines(), camera.height_px if camera.stripe_along == "width" else camera.width_px
    place = np.arange(lines)
    with CaptureWriter(folder / "ride.h5", header, dtype=np.dtype(np.uint8)) as writer:
        for k in range(min(frames, _DIFFERENT)):
            # A wavy bottom, without every fortieth line.
            centre = length * (0.5 + 0.1 * np.sin(2 * np.pi * (place / 200 + k / _DIFFERENT)))
            centre = np.where(place % 40 == 0, np.nan, centre + NOISE_PX * rng.normal(size=lines))
            image = draw_centres(centre, length, stripe_along=camera.stripe_along)
            writer.append(Frame(image, 0.0, True, 1.0, k / RATE_HZ))
    with h5py.File(folder / "ride.h5", "r+") as file:
        for name, dataset in file.items():
            first = None if name == "frames" else dataset[...]
            dataset.resize(frames, axis=0)
            if name == "time_s":
                dataset[...] = np.arange(frames) / RATE_HZ
            elif first is not None:
                dataset[...] = np.resize(first, dataset.shape)
            else:
                for k in range(_DIFFERENT, frames):
                    mask, chunk = dataset.id.read_direct_chunk((k % _DIFFERENT, 0, 0))
                    dataset.id.write_direct_chunk((k, 0, 0), chunk, mask)
    times = np.linspace(-1.0, frames / RATE_HZ + 1.0, max(20, frames // 10))
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, 0, 3] = SPEED_MM_PER_S * times
    drift = ((times - times[0]) / (times[-1] - times[0]) + 0.01)[:, None, None] ** 2
    navigation = Trajectory(times, poses, drift * np.diag(np.square(np.repeat([300.0, np.radians(1.0)], 3))))
    navigation.save(folder / "path.csv")


def run_alone(line: str, folder: Path, limit_gb: float) -> Cost:
    """Run a command in a process of its own and return its cost; ends with its exit code if it fails."""
    program, *arguments = line.split()
    command = [sys.executable, "-m", program, *arguments, "--quiet"]
    environment = os.environ | {"PYTHONPATH": str(Path.cwd()), "OPENBLAS_NUM_THREADS": "1"}
    start, own = time.perf_counter(), Path.cwd()
    os.chdir(folder)
    try:
        child = os.posix_spawn(sys.executable, command, environment)
    finally:
        os.chdir(own)
    _, status, usage = os.wait4(child, 0)
    if code := os.waitstatus_to_exitcode(status):
        sys.exit(code)
    # ru_maxrss is in KiB.
    peak_gb = usage.ru_maxrss * 1024 / 1e9
    return Cost(line, time.perf_counter() - start, usage.ru_utime + usage.ru_stime, peak_gb, limit_gb)
