"""The capture file: images of a scan with everything known about them, written frame by frame.

An HDF5 file with ``frames (N, H, W)`` (8 or 16 bit, one chunk per frame, Blosc zstd with bit shuffle, Fletcher-32
checksum), per frame ``stage_mm``, ``pose`` (4, 4), ``laser_on``, ``exposure_ms`` and ``time_s``, perhaps
``pose_covariance`` (6, 6), and attributes
``format``, ``version`` and ``header``: JSON with sensor, medium, target, artefact and provenance. Nothing in it is ever
executed, and real and synthetic captures look the same.

While it is being recorded the file is called ``NAME.part`` and every frame is flushed in HDF5's single-writer mode, so
an interrupted recording keeps all its complete frames; closing it gives it its name.
"""

import math
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import h5py
import hdf5plugin
import numpy as np

from uwlts.model.calibration import is_rigid
from uwlts.model.command_files import note_made, refuse_input
from uwlts.model.errors import CaptureError, ImageError, OutputError
from uwlts.model.input_file import require_regular_file
from uwlts.model.joint_estimate import CaptureSource
from uwlts.model.sensor import CaptureHeader, Table
from uwlts.storage.files import refuse_unsuitable, sha256_of
from uwlts.storage.hdf5_file import (
    UnfinishedFile,
    find_dataset,
    forget_plan,
    has_writer,
    read_label,
    read_plan,
    require_small_chunks,
    write_label,
    write_plan,
)
from uwlts.storage.json_files import differences
from uwlts.storage.one_writer import one_writer

FORMAT = "uwlts-capture"
VERSION = 1
_PER_FRAME = {"stage_mm": (), "pose": (4, 4), "laser_on": (), "exposure_ms": (), "time_s": ()}
_COVARIANCE = "pose_covariance"
# What h5py raises on a damaged file depends on where the damage is.
_DAMAGE = (OSError, RuntimeError, KeyError, ValueError, TypeError)
POSE_ROUNDED = 1e-4
"""By how much a pose's elements may be off a rotation, as tables give them with four decimals or more."""
# Room for HDF5's own bookkeeping when a frame is added: its index and the chunks of the other datasets.
_MARGIN_BYTES = 2**18


@dataclass(frozen=True)
class Frame:
    """One image (H, W) with its stage position, light, exposure, time, and pose ``T_scene_object`` (4, 4) if known.

    ``pose_covariance`` (6, 6) is that of the pose, if it is known: of the shift in mm, then of a further rotation in
    rad about the scene's axes. Where the capture states a mount the pose is the platform's.
    """

    image: np.ndarray
    stage_mm: float
    laser_on: bool
    exposure_ms: float
    time_s: float
    pose: np.ndarray | None = None
    pose_covariance: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class FrameTable:
    """What is known of each image of a recording besides its pixels, as of a `Capture`.

    ``stage_mm`` and ``exposure_ms`` are (N,), ``pose`` is (N, 4, 4), NaN where an image has none; ``path`` is what the
    recording is called.
    """

    header: CaptureHeader
    path: Path
    stage_mm: np.ndarray
    exposure_ms: np.ndarray
    pose: np.ndarray

    @classmethod
    def of(cls, header: CaptureHeader, frames: Sequence[Frame]) -> "FrameTable":
        """The table of frames that are in memory."""
        none = np.full((4, 4), np.nan)
        return cls(
            header,
            Path(header.name),
            np.array([frame.stage_mm for frame in frames]),
            np.array([frame.exposure_ms for frame in frames]),
            np.array([none if frame.pose is None else frame.pose for frame in frames]).reshape(-1, 4, 4),
        )


def sensor_poses(capture: "Capture | FrameTable") -> np.ndarray:
    """``T_scene_object`` (N, 4, 4) of the sensor's OCS: the poses, or the platform's with the mount of the drawing."""
    mount = capture.header.T_platform_sensor
    return capture.pose if mount is None else capture.pose @ np.array(mount)


def part_path(path: Path) -> Path:
    """Name of an unfinished recording of ``path``."""
    return path.with_name(path.name + ".part")


def _cut_to_used(path: Path) -> None:
    """Cut off space that was claimed and not used, as HDF5 does when a file is opened and closed once more."""
    h5py.File(path, "r+", locking=False).close()


def _recording_table(header: CaptureHeader, dtype: np.dtype, plan: Table | None) -> Table:
    """What a recording is to hold, as JSON."""
    return {"plan": plan, "images": str(dtype), "header": header.model_dump(mode="json")}


def _arrays(file: h5py.File) -> dict[str, h5py.Dataset]:
    """A capture's datasets by their names, in a file of this program's."""
    names = ("frames", *_PER_FRAME, *([_COVARIANCE] if _COVARIANCE in file else []))
    return {name: cast(h5py.Dataset, file[name]) for name in names}


def _dataset(file: h5py.File, name: str, path: Path) -> h5py.Dataset:
    dataset = find_dataset(file, name, path=path)
    if dataset is None or dataset.ndim == 0:
        raise CaptureError(f"{path} is damaged: it has no '{name}' for every frame")
    return dataset


class CaptureWriter(AbstractContextManager["CaptureWriter"]):
    """Records a capture. A context manager: leaving it normally finishes the file, an exception keeps the part.

    ``plan`` says, as JSON, what is to be recorded beyond what the header states; it is kept in the part and not in the
    finished capture. With ``covariances`` frames may have that of their pose.

    OutputError where the file exists (give ``overwrite``), is an input of the running command or is
    being written by another process, a part is left over (give ``resume`` or ``overwrite``), or storage fails;
    CaptureError for ``resume`` of a part that is damaged, or of another header or plan.
    """

    def __init__(
        self,
        path: str | Path,
        header: CaptureHeader,
        *,
        dtype: np.dtype,
        plan: Table | None = None,
        covariances: bool = False,
        overwrite: bool = False,
        resume: bool = False,
    ):
        self.path, self.header, self._plan = Path(path), header, plan
        self._per_frame = _PER_FRAME | ({_COVARIANCE: (6, 6)} if covariances else {})
        self._last_s = -math.inf
        self._part = part_path(self.path)
        camera = header.sensor.camera
        self._shape, self._dtype = (camera.height_px, camera.width_px), np.dtype(dtype)
        if self._dtype not in (np.uint8, np.uint16):
            raise ImageError(f"a capture holds images of uint8 or uint16, not of {self._dtype}")
        with self._storage(), ExitStack() as claimed:
            refuse_unsuitable(self.path, overwrite=overwrite)
            claimed.enter_context(one_writer(self.path))
            if not resume:
                refuse_input(self._part)
            if self._part.exists() and not (resume or overwrite):
                raise OutputError(
                    f"{self._part} is left from an interrupted run; give --resume to go on or --overwrite"
                )
            with self._left_over() if resume and self._part.exists() else nullcontext(()) as unfinished:
                self._begin(unfinished)
            # Nothing is locked: whoever looks at a running recording must not stop it.
            self._file = h5py.File(self._part, "r+", libver="latest", locking=False)
            self._file.swmr_mode = True
            self._arrays = _arrays(self._file)
            self._claimed = claimed.pop_all()

    def _left_over(self) -> "Capture":
        """The unfinished recording to go on with; CaptureError where it is not one of this capture."""
        try:
            unfinished = Capture(self._part)
        except CaptureError as error:
            raise CaptureError(f"cannot resume: {error}; give --overwrite to start afresh") from error
        there = _recording_table(unfinished.header, unfinished.dtype, unfinished.plan())
        if others := differences(there, _recording_table(self.header, self._dtype, self._plan)):
            unfinished.close()
            raise CaptureError(
                f"{self._part} belongs to another recording: {others}. Go on with the plan of that one, give "
                "another name, or --overwrite to start afresh"
            )
        return unfinished

    def _begin(self, unfinished: "Capture | Sequence[Frame]") -> None:
        """Put a valid part in place, empty or with the complete frames of the one left over.

        HDF5 cannot append to a killed writer's file, so a new one is made; it is made aside, so that a run that is
        killed meanwhile leaves the old one.
        """
        fresh = self._part.with_suffix(".fresh")
        try:
            with h5py.File(fresh, "w", libver="latest", locking=False) as self._file:
                self._claim_space()
                write_label(self._file, format=FORMAT, version=VERSION, header=self.header)
                if self._plan is not None:
                    write_plan(self._file, self._plan)
                # The checksum finds damage that the compression would decode to a different picture.
                self._file.create_dataset(
                    "frames",
                    (0, *self._shape),
                    self._dtype,
                    maxshape=(None, *self._shape),
                    chunks=(1, *self._shape),
                    fletcher32=True,
                    **hdf5plugin.Blosc(cname="zstd", clevel=1, shuffle=hdf5plugin.Blosc.BITSHUFFLE),
                )
                for name, shape in self._per_frame.items():
                    kind, chunks = bool if name == "laser_on" else float, (256, *shape)
                    # No checksum: a kill while 256 rows are rewritten would then lose them all, not only the last one.
                    self._file.create_dataset(name, (0, *shape), kind, maxshape=(None, *shape), chunks=chunks)
                self._arrays = _arrays(self._file)
                for frame in unfinished:
                    self._store(frame)
            _cut_to_used(fresh)
            os.replace(fresh, self._part)
        finally:
            fresh.unlink(missing_ok=True)

    def __len__(self) -> int:
        """Number of complete frames written."""
        return len(self._arrays["time_s"])

    def append(self, frame: Frame) -> None:
        """Store one frame; once this returns, the frame survives the end of the program.

        ImageError where the image has another size or type than the capture; CaptureError where stage position,
        exposure, time or pose is not finite, the exposure is negative, the time is before the last frame's, or the pose
        is no rotation with a shift (4, 4); OutputError where storage fails, the frames before being kept.
        """
        if frame.image.shape != self._shape or frame.image.dtype != self._dtype:
            raise ImageError(
                f"frame is {frame.image.shape} {frame.image.dtype}, the capture holds {self._shape} {self._dtype}"
            )
        if not np.isfinite([frame.stage_mm, frame.exposure_ms, frame.time_s]).all() or frame.exposure_ms < 0:
            raise CaptureError(
                f"a frame at stage position {frame.stage_mm} mm, exposure {frame.exposure_ms} ms and time "
                f"{frame.time_s} s cannot be stored: all three must be finite, the exposure not negative"
            )
        if frame.time_s < self._last_s:
            raise CaptureError(
                f"a frame at {frame.time_s} s cannot follow one at {self._last_s} s: give times that grow"
            )
        if frame.pose is not None and (np.shape(frame.pose) != (4, 4) or not np.isfinite(frame.pose).all()):
            raise CaptureError(f"a pose is a finite array (4, 4); found {frame.pose}")
        if frame.pose is not None and not is_rigid(frame.pose, within=POSE_ROUNDED):
            raise CaptureError(f"a pose is a rotation, a shift and 0 0 0 1; found {frame.pose.tolist()}")
        if frame.pose_covariance is not None:
            if _COVARIANCE not in self._per_frame:
                raise CaptureError("the capture was begun without covariances of poses: begin it with covariances=True")
            _require_covariances(np.asarray(frame.pose_covariance)[None], self.path)
        with self._storage():
            self._store(frame)

    def _store(self, frame: Frame) -> None:
        self._claim_space()
        pose = np.full((4, 4), np.nan) if frame.pose is None else frame.pose
        values = {"frames": frame.image, "stage_mm": frame.stage_mm, "pose": pose, "laser_on": frame.laser_on}
        values |= {"exposure_ms": frame.exposure_ms, "time_s": frame.time_s}
        if _COVARIANCE in self._per_frame:
            values[_COVARIANCE] = np.full((6, 6), np.nan) if frame.pose_covariance is None else frame.pose_covariance
        count = len(self)
        for name, value in values.items():
            dataset = self._arrays[name]
            dataset.resize(count + 1, axis=0)
            dataset[count] = value
            dataset.flush()
        self._last_s = frame.time_s

    def _claim_space(self) -> None:
        """Make the file long enough for one more frame, by zeros behind what HDF5 uses; OSError where the disk is full.

        HDF5 does not survive a full disk: closing the file fails and the process may crash.
        """
        frame_bytes = self._shape[0] * self._shape[1] * self._dtype.itemsize
        wanted = self._file.id.get_filesize() + frame_bytes + _MARGIN_BYTES
        with open(self._file.filename, "r+b", buffering=0) as file:
            size = file.seek(0, os.SEEK_END)
            while size < wanted:
                size += file.write(bytes(wanted - size))

    @contextmanager
    def _storage(self) -> Iterator[None]:
        """A context in which failures of the storage become OutputErrors."""
        try:
            yield
        except (OSError, RuntimeError) as error:
            number = getattr(error, "errno", None)
            reason = os.strerror(number) if number else " ".join(str(error).split())
            kept = f"; complete frames are kept in {self._part.name}" if os.path.exists(self._part) else ""
            raise OutputError(f"cannot write {self.path}: {reason}{kept}") from error

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        with self._claimed, self._storage():
            self._file.close()
            if kind is None:
                if self._plan is not None:
                    forget_plan(self._part)
                _cut_to_used(self._part)
                os.replace(self._part, self.path)
                note_made(self.path)


def _require_covariances(values: np.ndarray, path: Path) -> None:
    """CaptureError where values (N, 6, 6) are no covariances."""
    if values.shape[1:] != (6, 6) or not np.isfinite(values).all():
        raise CaptureError(f"{path}: the covariance of a pose is a finite array (6, 6)")
    sizes = np.sqrt(np.maximum(np.einsum("nii->ni", values), 1e-30))
    scaled = values / (sizes[:, :, None] * sizes[:, None])
    if np.abs(scaled - np.swapaxes(scaled, 1, 2)).max() > 1e-6 or np.linalg.eigvalsh(scaled).min() < -1e-6:
        raise CaptureError(f"{path}: the covariance of a pose is symmetric without negative variances")


def _what_is_wrong(error: Exception) -> str:
    """HDF5's message about a file that it cannot open; the two most usual ones in plain English."""
    if found := re.search(r"truncated file: eof = (\d+).*stored_eof = (\d+)", str(error)):
        return f"{int(found[1]):,} of its {int(found[2]):,} bytes are there; copy it again"
    if "file signature not found" in str(error):
        return "it is no HDF5 file"
    return f"HDF5 says: {error}"


class Capture(AbstractContextManager["Capture"]):
    """A capture opened for reading: per-frame arrays in memory, images read on demand.

    A recording that is still going on can be read too; it has the frames that were complete when it was opened.

    Attributes
    ----------
    header : CaptureHeader
        What holds for all frames.
    dtype : dtype
        Type of the images, uint8 or uint16.
    stage_mm, exposure_ms, time_s : (N,) float64
        Stage position in mm, exposure in ms, time in s of every frame; finite, exposures not negative, and times not
        running backwards.
    laser_on : (N,) bool
        Whether the laser was on, rather than the lamp.
    pose : (N, 4, 4) float64
        ``T_scene_object`` of the sensor's OCS, a rotation with a shift; all NaN for a frame without one. It is that of
        the platform, ``T_scene_platform``, where the header states ``T_platform_sensor``.
    pose_covariance : (N, 6, 6) float64 or None
        Covariance of each pose (`Frame`), all NaN where it is not known; None in captures without any.

    Raises
    ------
    CaptureError
        The file is missing, foreign, truncated, of a newer version, or contradicts itself.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        require_regular_file(self.path, called="capture")
        try:
            unfinished = not self.finished or has_writer(self.path)
            self.file = UnfinishedFile(self.path) if unfinished else h5py.File(self.path, "r")
        except _DAMAGE as error:
            raise CaptureError(f"{self.path} is not a capture, or is truncated: {_what_is_wrong(error)}") from error
        try:
            self.header = read_label(self.file, CaptureHeader, path=self.path, format=FORMAT, version=VERSION)
            self._read_frames(unfinished=unfinished)
        except _DAMAGE as error:
            self.file.close()
            raise CaptureError(f"{self.path} is damaged: {error}") from error
        except BaseException:
            self.file.close()
            raise

    def _read_frames(self, *, unfinished: bool) -> None:
        camera = self.header.sensor.camera
        images = self._dataset("frames", (camera.height_px, camera.width_px), "u")
        if images.chunks != (1, *images.shape[1:]) or images.dtype.itemsize > 2:
            raise CaptureError(f"{self.path} is damaged: frames are {images.dtype} in chunks of {images.chunks}")
        columns = {
            name: self._dataset(name, shape, "b" if name == "laser_on" else "f") for name, shape in _PER_FRAME.items()
        }
        for name, dataset in columns.items():
            require_small_chunks(dataset, name, path=self.path)
        self._images, self.dtype = images, images.dtype
        self._count = min(len(images), *map(len, columns.values()))
        # HDF5 shows chunks that were never stored as zeros.
        if images.id.get_num_chunks() < self._count:
            raise CaptureError(f"{self.path} is damaged: it holds {images.id.get_num_chunks()} of {self._count} images")
        self.stage_mm, self.pose, self.laser_on, self.exposure_ms, self.time_s = (
            dataset[: self._count] for dataset in columns.values()
        )
        if not all(np.isfinite(values).all() for values in (self.stage_mm, self.exposure_ms, self.time_s)):
            raise CaptureError(f"{self.path} holds stage positions, exposures or times that are not finite")
        self.pose_covariance: np.ndarray | None = None
        if _COVARIANCE in self.file:
            covariances: np.ndarray = self._dataset(_COVARIANCE, (6, 6), "f")[: self._count]
            known = np.isfinite(covariances).all(axis=(1, 2))
            if known.any():
                _require_covariances(covariances[known], self.path)
            self.pose_covariance = covariances
        finite = np.isfinite(self.pose).reshape(self._count, 16)
        if (finite.any(axis=1) != finite.all(axis=1)).any():
            raise CaptureError(f"{self.path} holds poses of which only some elements are known")
        if not is_rigid(self.pose[finite.all(axis=1)], within=POSE_ROUNDED):
            raise CaptureError(f"{self.path} holds poses that are no rotation with a shift")
        if (self.exposure_ms < 0).any():
            raise CaptureError(f"{self.path} holds negative exposures")
        if unfinished and self._count > 1 and self.time_s[-1] < self.time_s[-2]:
            # The writer was killed between making room for its last frame and storing it.
            self._count -= 1
            for name in (*_PER_FRAME, *([] if self.pose_covariance is None else [_COVARIANCE])):
                setattr(self, name, getattr(self, name)[: self._count])
        if (np.diff(self.time_s) < 0).any():
            raise CaptureError(f"{self.path} holds times that run backwards")

    def _dataset(self, name: str, shape: tuple[int, ...], kind: str) -> h5py.Dataset:
        """A dataset with one row of a shape per frame; CaptureError where it is something else."""
        dataset = _dataset(self.file, name, self.path)
        if dataset.shape[1:] != shape or dataset.dtype.kind != kind:
            raise CaptureError(
                f"{self.path} contradicts itself: '{name}' is {dataset.dtype} of {dataset.shape[1:]} per frame, "
                f"expected {shape} of kind '{kind}'"
            )
        return dataset

    def __len__(self) -> int:
        return self._count

    @property
    def finished(self) -> bool:
        """Whether the recording was closed, rather than interrupted."""
        return self.path.suffix != ".part"

    def plan(self) -> Table | None:
        """The plan of an unfinished recording; None where it has none."""
        return read_plan(self.file)

    def image(self, index: int) -> np.ndarray:
        """Image (H, W) of a frame; raises CaptureError where its data are damaged."""
        if not 0 <= index < self._count:
            raise IndexError(f"frame {index} of {self._count}")
        try:
            return self._images[index]
        except _DAMAGE as error:
            raise CaptureError(f"frame {index} of {self.path} cannot be read: the file is damaged ({error})") from error

    def __getitem__(self, index: int) -> Frame:
        """A frame with everything known about it; raises CaptureError where its data are damaged."""
        index = index + self._count if index < 0 else index
        image = self.image(index)
        columns = (self.stage_mm, self.laser_on, self.exposure_ms, self.time_s)
        pose = self.pose[index] if np.isfinite(self.pose[index]).all() else None
        own = None if self.pose_covariance is None else self.pose_covariance[index]
        covariance = own if own is not None and np.isfinite(own).all() else None
        return Frame(image, *(column[index].item() for column in columns), pose=pose, pose_covariance=covariance)

    def frames(self, *, laser_on: bool | None = None) -> Iterator[tuple[int, np.ndarray]]:
        """Index and image of all frames, or only of those with the laser on or off."""
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


def open_capture(path: str | Path) -> Capture:
    """Open a capture file (HDF5) for reading; CaptureError as from `Capture`.

    Per-frame values are read at once, images when they are asked for: ``capture[12]`` is a `Frame`. A recording that is
    still being written can be opened by its name ``NAME.part``; it has the frames that were complete then.

    Examples
    --------
    >>> with uwlts.open_capture("spheres.h5") as capture:
    ...     images = [frame.image for frame in capture if frame.laser_on]
    """
    return Capture(path)


@contextmanager
def opened_captures(captures: Iterable[Capture | str | Path]) -> Iterator[list[Capture]]:
    """A context with several captures, each as from `opened_capture`."""
    with ExitStack() as stack:
        yield [stack.enter_context(opened_capture(each)) for each in captures]


def opened_capture(capture: Capture | str | Path) -> AbstractContextManager[Capture]:
    """A context with an opened capture: one that is open already stays so, a file is opened and closed."""
    return nullcontext(capture) if isinstance(capture, Capture) else Capture(capture)


def source_of(capture: Capture) -> CaptureSource:
    """Name, SHA-256 and number of images of a capture, its medium and window, and its subject."""
    header, laser = capture.header, int(np.count_nonzero(capture.laser_on))
    medium = header.medium
    known: Table = {"medium": header.medium_name, "window": header.sensor.camera.window.mounted}
    if medium.kind in ("fresh", "sea"):
        known |= {"temperature_c": medium.temperature_c, "salinity_g_kg": medium.salinity_g_kg}
    known |= {key: thing for key in ("target", "artefact") if (thing := getattr(header, key)) is not None}
    identity: Table = {"file": capture.path.name, "name": header.name, "sha256": sha256_of(capture.path)}
    counts: Table = {"lamp_images": len(capture) - laser, "laser_images": laser}
    return CaptureSource.model_validate(identity | counts | known)
