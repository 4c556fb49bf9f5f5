"""Memory of reconstruction along a path: profiles of a 3D camera on a vehicle, with poses, mount and covariance."""

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from tests.uwlts.mount_views import known_mount
from uwlts.model.library import load_sensor
from uwlts.model.sensor import CaptureHeader, Sensor
from uwlts.model.stripe import Coordinates
from uwlts.model.trajectory import Trajectory
from uwlts.recalibration.as_built import as_built
from uwlts.storage.capture import Frame
from uwlts.storage.capture_writer import CaptureWriter

RATE_HZ, SPEED_MM_PER_S, NOISE_PX = 200.0, 100.0, 0.1
"""Of the profiles, of the vehicle, and of the stripe centres."""
_DIFFERENT = 64  # profiles of the capture; further ones repeat them


@dataclass(frozen=True)
class Cost:
    """Cost of a command, and the most memory that it may take."""

    command: str
    seconds: float
    processor_s: float
    peak_gb: float
    limit_gb: float


def stream_memory(few: int, many: int) -> tuple[float, float]:
    """Return the peak memory of the larger number of frames in GB, and the growth in kB per frame."""
    peaks = []
    with TemporaryDirectory() as name:
        for frames in (few, many):
            folder = Path(name, str(frames))
            folder.mkdir()
            line = write_vehicle(folder, frames)
            peaks.append(run_alone(line, folder, np.inf).peak_gb)
    return peaks[1], 1e6 * (peaks[1] - peaks[0]) / (many - few)


def write_vehicle(folder: Path, frames: int) -> str:
    """Write capture, calibration, mount and trajectory of a ride; return the command that reconstructs it."""
    sensor, rng = load_sensor("thesis-small"), np.random.default_rng(65)
    header = CaptureHeader(
        name="ride",
        sensor=sensor,
        medium_name="water",
        medium=sensor.media["water"],
        stage_direction=(1.0, 0.0, 0.0),
        saturation_dn=255,
    )
    as_built(sensor, sensor.media["water"]).save(folder / "calibration.json")
    mount = known_mount(np.eye(4), time_offset_s=0.0, time_offset_std_s=1e-4)
    mount.save(folder / "mount.json")
    with CaptureWriter(folder / "ride.h5", header, dtype=np.dtype(np.uint8), centre_lines=True) as writer:
        profiles = [_profile(sensor, k, rng) for k in range(_DIFFERENT)]
        for k in range(frames):
            writer.append(Frame(profiles[k % _DIFFERENT], 0.0, True, 1.0, k / RATE_HZ))
    _path(frames).save(folder / "path.csv")
    return (
        "uwlts reconstruct ride.h5 --calibration calibration.json --mount mount.json --trajectory path.csv "
        "--out ride.cloud.h5"
    )


def _profile(sensor: Sensor, number: int, rng: np.random.Generator):
    """Return a profile of a wavy bottom, with noise, and without every fortieth line."""
    camera = sensor.camera
    lines, length = camera.lines(), camera.height_px if camera.stripe_along == "width" else camera.width_px
    place = np.arange(lines)
    centre = length * (0.5 + 0.1 * np.sin(2 * np.pi * (place / 200 + number / _DIFFERENT)))
    centre += NOISE_PX * rng.normal(size=lines)
    rows = np.stack([np.where(place % 40 == 0, np.nan, centre), 100 + rng.normal(size=lines), np.full(lines, 4.0)])
    return Coordinates().stripe(rows, stripe_along=camera.stripe_along, length_px=length)


def _path(frames: int) -> Trajectory:
    """Return a straight way along X with a pose every tenth profile, and the covariance of a drift."""
    times = np.linspace(-1.0, frames / RATE_HZ + 1.0, max(20, frames // 10))
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, 0, 3] = SPEED_MM_PER_S * times
    part = ((times - times[0]) / (times[-1] - times[0]))[:, None, None]
    return Trajectory(times, poses, (0.01 + part) ** 2 * np.diag(np.square(np.repeat([300.0, np.radians(1.0)], 3))))


def run_alone(line: str, folder: Path, limit_gb: float) -> Cost:
    """Run a command in a process of its own and return its cost; ends with its exit code if it fails."""
    import time

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
    return Cost(
        line, time.perf_counter() - start, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024 / 1e9, limit_gb
    )
