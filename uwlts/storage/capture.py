"""Capture file: the frames of a camera with all metadata; `capture_writer` writes it.

An HDF5 file with ``frames (N, H, W)`` (8 or 16 bit, one chunk per frame, Blosc zstd with bit shuffle, Fletcher-32
checksum) and, per frame, ``stage_mm``, ``pose`` (4, 4), ``laser_on``, ``exposure_ms``, ``time_s`` and optionally
``pose_covariance`` (6, 6). Its attributes are ``format``, ``version`` and ``header``: JSON with sensor, medium, target,
artefact and provenance. Nothing in the file is ever executed, and real and synthetic captures have the same structure.

A capture of a moving stage (version 2) has ``speed_mm_per_s (N,)``, positive for growing positions, and the stage's
reports during the motion: ``stage_reports (M, 2)`` with time in s on the frames' clock and position in mm.

During recording the file is called ``NAME.part`` and every frame is flushed in HDF5's single-writer mode, so that an
interrupted recording keeps all its complete frames. Closing the file renames it.
"""

import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import hdf5plugin  # noqa: F401, gives HDF5 the filter by which frames are read
import numpy as np

from uwlts.argument_types import check_arguments
from uwlts.errors import CaptureError
from uwlts.files.reading import require_regular_file
from uwlts.files.writing import hash_file
from uwlts.model.joint_estimate import CaptureSource
from uwlts.model.sensor import CaptureHeader, Table, is_rigid
from uwlts.storage.hdf5_file import (
    DAMAGE,
    find_dataset,
    has_writer,
    open_unfinished,
    read_label,
    read_plan,
    read_values,
    require_small_chunks,
)

FORMAT = "uwlts-capture"
VERSION = 2
"""Version of captures of a moving stage; captures at rest have version 1."""
PER_FRAME: dict[str, tuple[tuple[int, ...], type]] = {"stage_mm": ((), float), "pose": ((4, 4), float)}
PER_FRAME |= {"laser_on": ((), bool), "exposure_ms": ((), float), "time_s": ((), float)}
"""Columns of every capture, with the shape and the type of one frame's value."""
COVARIANCE = "pose_covariance"
SPEED = "speed_mm_per_s"
"""Column of a moving stage."""
POSE_ROUNDED = 1e-4
"""Largest deviation of a pose's elements from a rotation, for tables with four or more decimals."""


@dataclass(frozen=True)
class Frame:
    """An image (H, W) of uint8 or uint16 with stage position, light, exposure, time, and pose if known.

    ``pose`` (4, 4) is ``T_scene_object``, or that of the platform if the capture states a mount. ``pose_covariance``
    (6, 6) is that of the shift in mm, then of a further rotation in rad about the scene's axes, if known.

    For a moving stage, position and time are those at the middle of the exposure; with a rolling shutter, of the
    image's middle row.
    """

    image: np.ndarray
    stage_mm: float
    laser_on: bool
    exposure_ms: float
    time_s: float
    pose: np.ndarray | None = None
    speed_mm_per_s: float = 0.0
    pose_covariance: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class FrameTable:
    """Metadata of the images of a recording, with the attributes of `Capture`.

    ``stage_mm``, ``exposure_ms`` and ``speed_mm_per_s`` are (N,). ``pose`` is (N, 4, 4), NaN for images without one.
    ``path`` is the name of the recording.
    """

    header: CaptureHeader
    path: Path
    stage_mm: np.ndarray
    exposure_ms: np.ndarray
    pose: np.ndarray
    speed_mm_per_s: np.ndarray

    @classmethod
    def from_frames(cls, header: CaptureHeader, frames: Sequence[Frame]) -> "FrameTable":
        """Return the table of frames in memory."""
        stage, exposure, speed = (
            np.array([(f.stage_mm, f.exposure_ms, f.speed_mm_per_s) for f in frames]).reshape(-1, 3).T
        )
        poses = [np.full((4, 4), np.nan) if frame.pose is None else frame.pose for frame in frames]
        return cls(header, Path(header.name), stage, exposure, np.array(poses).reshape(-1, 4, 4), speed)


def sensor_poses(capture: "Capture | FrameTable") -> np.ndarray:
    """Return ``T_scene_object`` (N, 4, 4) of the sensor's OCS: the poses, combined with the mount if there is one."""
    mount = capture.header.T_platform_sensor
    return capture.pose if mount is None else capture.pose @ np.array(mount)


CAPTURES = (".h5",)
"""File name endings of captures."""

NO_STAGE = "none: stage_mm counts the poses"
"""Entry ``stage`` in the provenance of a capture with free poses, where ``stage_mm`` is only a number."""


def part_path(path: Path) -> Path:
    """Return the name of an unfinished recording of ``path``."""
    return path.with_name(path.name + ".part")


def require_covariances(values: np.ndarray, path: Path) -> None:
    """Raise CaptureError if values (N, 6, 6) are not covariances."""
    if values.shape[1:] != (6, 6) or not np.isfinite(values).all():
        raise CaptureError(f"{path}: the covariance of a pose is a finite array (6, 6)")
    sizes = np.sqrt(np.maximum(np.einsum("nii->ni", values), 1e-30))
    scaled = values / (sizes[:, :, None] * sizes[:, None])
    if np.abs(scaled - np.swapaxes(scaled, 1, 2)).max() > 1e-6 or np.linalg.eigvalsh(scaled).min() < -1e-6:
        raise CaptureError(f"{path}: the covariance of a pose is symmetric without negative variances")


def _explain_damage(error: Exception) -> str:
    """Return HDF5's message about a file that it cannot open; the two most frequent ones in plain English."""
    if found := re.search(r"truncated file: eof = (\d+).*stored_eof = (\d+)", str(error)):
        return f"it has {int(found[1]):,} of its {int(found[2]):,} bytes; copy it again"
    return "it is not an HDF5 file" if "file signature not found" in str(error) else f"HDF5 reports: {error}"


class Capture(AbstractContextManager["Capture"]):
    """A capture opened for reading: metadata in memory, images read on demand.

    A recording in progress can be read, too; it has the frames that were complete when it was opened.

    Attributes
    ----------
    header : CaptureHeader
        Metadata common to all frames.
    dtype : dtype
        Type of the images, uint8 or uint16.
    stage_mm, exposure_ms, time_s : (N,) float64
        Stage position, exposure and time of every frame: finite, exposures not negative, times not decreasing.
    laser_on : (N,) bool
        Whether the laser was on, rather than the lamp.
    pose : (N, 4, 4) float64
        ``T_scene_object`` of the sensor's OCS, a rotation with a shift; all NaN for a frame without one. It is that of
        the platform, ``T_scene_platform``, if the header states ``T_platform_sensor``.
    pose_covariance : (N, 6, 6) float64 or None
        Covariance of each pose (`Frame`), all NaN if unknown; None in captures without any.
    speed_mm_per_s : (N,) float64
        Speed of the stage at each frame, positive for growing positions; 0 at rest.
    stage_reports : (M, 2) float64
        Reports of the stage during the motion: time in s on the clock of ``time_s``, and position in mm.

    Raises
    ------
    CaptureError
        The file is missing, foreign, truncated, of a newer version, or contradicts itself; or it has centre lines of a
        3D camera, which versions before 0.3 recorded.
    """

    @check_arguments
    def __init__(self, path: str | Path):
        self.path = Path(path)
        require_regular_file(self.path, called="capture")
        try:
            unfinished = not self.finished or has_writer(self.path)
            self.file = open_unfinished(self.path) if unfinished else h5py.File(self.path, "r")
        except DAMAGE as error:
            raise CaptureError(f"{self.path} is not a capture, or is truncated: {_explain_damage(error)}") from error
        try:
            self.header = read_label(self.file, CaptureHeader, path=self.path, file_format=FORMAT, version=VERSION)
            self._read_frames(unfinished=unfinished)
        except DAMAGE as error:
            self.file.close()
            raise CaptureError(f"{self.path} is damaged: {error}") from error
        except BaseException:
            self.file.close()
            raise

    def _read_frames(self, *, unfinished: bool) -> None:
        if "centre_lines" in self.file:
            raise CaptureError(
                f"{self.path} has centre lines of a 3D camera, expected images only: read it with uwlts 0.2, or record "
                "images with the camera's pixel format Mono8"
            )
        camera = self.header.sensor.camera
        images = self._open_dataset("frames", (camera.height_px, camera.width_px), "u")
        if images.chunks != (1, *images.shape[1:]) or images.dtype.itemsize > 2:
            raise CaptureError(f"{self.path} is damaged: frames are {images.dtype} in chunks of {images.chunks}")
        held = PER_FRAME | ({SPEED: ((), float)} if SPEED in self.file else {})
        columns = {name: self._open_column(name, shape, np.dtype(kind).kind) for name, (shape, kind) in held.items()}
        self._images, self.dtype = images, images.dtype.newbyteorder("=")
        self.moving = "stage_reports" in self.file
        self._count = min(map(len, (images, *columns.values())))
        speed = columns.get(SPEED)
        self.speed_mm_per_s = np.zeros(self._count) if speed is None else read_values(speed, slice(self._count))
        reports = self._open_column("stage_reports", (2,), "f") if self.moving else None
        self.stage_reports = np.empty((0, 2)) if reports is None else read_values(reports)
        # HDF5 returns zeros for chunks that were never stored.
        if (stored := images.id.get_num_chunks()) < self._count:
            raise CaptureError(f"{self.path} is damaged: it holds {stored} of {self._count} images")
        self.stage_mm, self.pose, self.laser_on, self.exposure_ms, self.time_s = (
            read_values(columns[name], slice(self._count)) for name in PER_FRAME
        )
        for numbers, called in (
            ((self.speed_mm_per_s, self.stage_reports), "speeds or reports of the stage"),
            ((self.stage_mm, self.exposure_ms, self.time_s), "stage positions, exposures or times"),
        ):
            if not all(np.isfinite(values).all() for values in numbers):
                raise CaptureError(f"{self.path} holds {called} that are not finite")
        self.pose_covariance = self._check_poses()
        if unfinished and self._count > 1 and self.time_s[-1] < self.time_s[-2]:
            # The writer was killed between extending the datasets and storing its last frame.
            self._count -= 1
            for name in (*PER_FRAME, SPEED, *([] if self.pose_covariance is None else [COVARIANCE])):
                setattr(self, name, getattr(self, name)[: self._count])
        if (np.diff(self.time_s) < 0).any():
            raise CaptureError(f"{self.path} holds times that decrease")

    def _check_poses(self) -> np.ndarray | None:
        """Check exposures and poses, and return the covariances of the poses if the file has them."""
        if (self.exposure_ms < 0).any():
            raise CaptureError(f"{self.path} holds negative exposures")
        finite = np.isfinite(self.pose).reshape(self._count, 16)
        if (finite.any(axis=1) != finite.all(axis=1)).any():
            raise CaptureError(f"{self.path} holds poses with only some of their elements")
        if not is_rigid(self.pose[finite.all(axis=1)], within=POSE_ROUNDED):
            raise CaptureError(f"{self.path} holds poses that are no rotation with a shift")
        if COVARIANCE not in self.file:
            return None
        covariances = read_values(self._open_column(COVARIANCE, (6, 6), "f"), slice(self._count))
        known = np.isfinite(covariances).all(axis=(1, 2))
        if known.any():
            require_covariances(covariances[known], self.path)
        return covariances

    def _open_dataset(self, name: str, shape: tuple[int, ...], kind: str) -> h5py.Dataset:
        """Return a dataset with one row of this shape per frame; raises CaptureError for any other dataset."""
        dataset = find_dataset(self.file, name, path=self.path)
        if dataset is None or dataset.ndim == 0:
            raise CaptureError(f"{self.path} is damaged: it has no '{name}' for every frame")
        if dataset.shape[1:] != shape or dataset.dtype.kind != kind:
            raise CaptureError(
                f"{self.path} contradicts itself: '{name}' is {dataset.dtype} of {dataset.shape[1:]} per frame, "
                f"expected {shape} of kind '{kind}'"
            )
        return dataset

    def _open_column(self, name: str, shape: tuple[int, ...], kind: str) -> h5py.Dataset:
        """Return such a dataset that is read as a whole."""
        dataset = self._open_dataset(name, shape, kind)
        require_small_chunks(dataset, name, path=self.path)
        return dataset

    def __repr__(self) -> str:
        """Return the file name and the numbers of images."""
        return f"Capture: {self.path.name}, {len(self)} images, {int(self.laser_on.sum())} with the laser on"

    def __len__(self) -> int:
        return self._count

    @property
    def finished(self) -> bool:
        """True if the recording was finished, false if it was interrupted."""
        return self.path.suffix != ".part"

    def plan(self) -> Table | None:
        """Return the plan of an unfinished recording, or None."""
        return read_plan(self.file)

    def image(self, index: int) -> np.ndarray:
        """Return the image (H, W) of a frame; raises CaptureError if its data are damaged."""
        if not 0 <= index < self._count:
            raise IndexError(f"frame {index} of {self._count}")
        try:
            return read_values(self._images, index)
        except DAMAGE as error:
            why = f"the file is damaged, or there is too little memory ({error})"
            raise CaptureError(f"frame {index} of {self.path} cannot be read: {why}") from error

    def __getitem__(self, index: int) -> Frame:
        """Return a frame with its metadata; raises CaptureError if its data are damaged."""
        known: dict[str, Any]
        index = index + self._count if index < 0 else index
        image = self.image(index)
        columns = (self.stage_mm, self.laser_on, self.exposure_ms, self.time_s)
        known = {SPEED: self.speed_mm_per_s[index].item()}
        for name, values in (("pose", self.pose), (COVARIANCE, self.pose_covariance)):
            known[name] = values[index] if values is not None and np.isfinite(values[index]).all() else None
        return Frame(image, *(column[index].item() for column in columns), **known)

    def frames(self, *, laser_on: bool | None = None) -> Iterator[tuple[int, np.ndarray]]:
        """Iterate over indices and images, of one light if given."""
        for index in range(self._count):
            if laser_on is None or bool(self.laser_on[index]) == laser_on:
                yield index, self.image(index)

    def __iter__(self) -> Iterator[Frame]:
        return (self[index] for index in range(self._count))

    def close(self) -> None:
        """Close the file."""
        self.file.close()

    def __exit__(self, *_: object) -> None:
        self.close()


@contextmanager
def open_captures(captures: Iterable[Capture | str | Path]) -> Iterator[list[Capture]]:
    """Open several captures as a context, each as by `open_capture`."""
    with ExitStack() as stack:
        yield [stack.enter_context(open_capture(each)) for each in captures]


def open_capture(capture: Capture | str | Path) -> AbstractContextManager[Capture]:
    """Return a context with a capture: a path is opened and closed, an open capture stays open."""
    return nullcontext(capture) if isinstance(capture, Capture) else Capture(capture)


def describe_source(capture: Capture) -> CaptureSource:
    """Return name, SHA-256, numbers of images, medium, window and subject of a capture."""
    header, laser = capture.header, int(np.count_nonzero(capture.laser_on))
    medium = header.medium
    known: Table = {"medium": header.medium_name, "window": header.sensor.camera.window.mounted}
    if (offset := header.sensor.camera.offset_px) is not None:
        known |= {"offset_px": list(offset)}
    if medium.kind in ("fresh", "sea"):
        known |= {"temperature_c": medium.temperature_c, "salinity_g_kg": medium.salinity_g_kg}
    described = {
        "target": header.target,
        "artefact": header.artefact,
        "black_level": header.provenance.get("black_level"),
    }
    known |= {key: thing for key, thing in described.items() if thing is not None}
    identity: Table = {"file": capture.path.name, "name": header.name, "sha256": hash_file(capture.path)}
    counts: Table = {"lamp_images": len(capture) - laser, "laser_images": laser}
    return CaptureSource.model_validate(identity | counts | known)
