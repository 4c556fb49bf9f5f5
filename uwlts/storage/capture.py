"""The capture file: what a camera saw of a scan, with everything known about it, written frame by frame.

An HDF5 file with ``frames (N, H, W)`` (8 or 16 bit, one chunk per frame, Blosc zstd with bit shuffle, Fletcher-32
checksum), per frame ``stage_mm``, ``pose`` (4, 4), ``laser_on``, ``exposure_ms`` and ``time_s``, perhaps
``pose_covariance`` (6, 6), and attributes
``format``, ``version`` and ``header``: JSON with sensor, medium, target, artefact and provenance. Nothing in it is ever
executed, and real and synthetic captures look the same.

The frames of a 3D camera, which finds the stripe itself, are centre lines (version 2): ``centre_lines (N, 4, L)`` has
the rows centre, amplitude, width and status of a `Stripe`, ``has_image (N,)`` says which frames are images all the
same, such as those of a target, and ``encoder (N,)`` is the count of an encoder at each frame, NaN where there is none.
A part of ``frames`` or ``centre_lines`` that a frame does not have takes no space.

Frames of a stage that moves have its ``speed_mm_per_s (N,)`` (version 2 too), positive where positions grow, and the
capture holds what the stage reported meanwhile: ``stage_reports (M, 2)``, time in s of the frames' clock and position.

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
from uwlts.model.sensor import Camera, CaptureHeader, Table
from uwlts.model.stripe import ROWS, Stripe, StripeStatus, rows_of
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
VERSION = 2
"""Of captures with centre lines or a moving stage; those of images at rest have version 1."""
_PER_FRAME = {"stage_mm": (), "pose": (4, 4), "laser_on": (), "exposure_ms": (), "time_s": ()}
_COVARIANCE = "pose_covariance"
_MORE = {"has_image": bool, "encoder": float, "speed_mm_per_s": float}
"""Columns of version 2."""
# What h5py raises on a damaged file depends on where the damage is.
_DAMAGE = (OSError, RuntimeError, KeyError, ValueError, TypeError)
POSE_ROUNDED = 1e-4
"""By how much a pose's elements may be off a rotation, as tables give them with four decimals or more."""
# Room for HDF5's own bookkeeping when a frame is added: its index and the chunks of the other datasets.
_MARGIN_BYTES = 2**18


Seen = np.ndarray | Stripe
"""What a camera gives of a moment: an image (H, W) of uint8 or uint16, or of a 3D camera the stripe that it found."""


def image_of(seen: Seen, called: str) -> np.ndarray:
    """What was seen as an image (H, W); ImageError where it is a centre line."""
    if isinstance(seen, Stripe):
        raise ImageError(
            f"{called} is a centre line, as a 3D camera gives it, where an image is needed: take images with its pixel "
            "format Mono8 for targets and exposures"
        )
    return seen


def picture_of(seen: Seen, camera: Camera) -> np.ndarray:
    """What was seen as an image (H, W) to draw on: dark for a centre line."""
    return np.zeros((camera.height_px, camera.width_px), np.uint8) if isinstance(seen, Stripe) else seen


@dataclass(frozen=True)
class Frame:
    """What was seen, with its stage position, light, exposure, time, and pose ``T_scene_object`` (4, 4) if known.

    ``pose_covariance`` (6, 6) is that of the pose, if it is known: of the shift in mm, then of a further rotation in
    rad about the scene's axes. Where the capture states a mount the pose is the platform's.

    ``encoder`` is the count of an encoder at that moment, where there is one. Of a stage that moves, position and time
    are those in the middle of the exposure, of an image's middle row where the shutter is rolling.
    """

    seen: Seen
    stage_mm: float
    laser_on: bool
    exposure_ms: float
    time_s: float
    pose: np.ndarray | None = None
    encoder: float | None = None
    speed_mm_per_s: float = 0.0
    pose_covariance: np.ndarray | None = None

    @property
    def image(self) -> np.ndarray:
        """The image (H, W); ImageError where it is a centre line."""
        return image_of(self.seen, f"the frame at {self.time_s:g} s")


@dataclass(frozen=True, eq=False)
class FrameTable:
    """What is known of each image of a recording besides its pixels, as of a `Capture`.

    ``stage_mm``, ``exposure_ms`` and ``speed_mm_per_s`` are (N,), ``pose`` is (N, 4, 4), NaN where an image has none;
    ``path`` is what the recording is called.
    """

    header: CaptureHeader
    path: Path
    stage_mm: np.ndarray
    exposure_ms: np.ndarray
    pose: np.ndarray
    speed_mm_per_s: np.ndarray

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
            np.array([frame.speed_mm_per_s for frame in frames]),
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


def _recording_table(header: CaptureHeader, dtype: np.dtype, plan: Table | None, *, lines: bool, moving: bool) -> Table:
    """What a recording is to hold, as JSON."""
    held = f"{dtype}{' and centre lines' if lines else ''}{', moving' if moving else ''}"
    return {"plan": plan, "images": held, "header": header.model_dump(mode="json")}


def _arrays(file: h5py.File) -> dict[str, h5py.Dataset]:
    """A capture's datasets by their names, in a file of this program's."""
    names = ("frames", "centre_lines", "stage_reports", *_MORE, _COVARIANCE, *_PER_FRAME)
    return {name: cast(h5py.Dataset, file[name]) for name in names if name in file}


def _dataset(file: h5py.File, name: str, path: Path) -> h5py.Dataset:
    dataset = find_dataset(file, name, path=path)
    if dataset is None or dataset.ndim == 0:
        raise CaptureError(f"{path} is damaged: it has no '{name}' for every frame")
    return dataset


class CaptureWriter(AbstractContextManager["CaptureWriter"]):
    """Records a capture. A context manager: leaving it normally finishes the file, an exception keeps the part.

    ``dtype`` is that of images; with ``centre_lines`` laser frames are centre lines, with ``moving`` frames have a
    speed, and the stage's reports are added by `place`; with ``covariances`` frames may have that of their pose.
    ``plan`` says, as JSON, what is to be recorded beyond what the header states; it is kept in the part and not in the
    finished capture. OutputError where the file exists (give ``overwrite``), is an input of the running command or is
    being written by another process, a part is left over (give ``resume`` or ``overwrite``), or storage fails;
    CaptureError for ``resume`` of a part that is damaged, or of another header or plan.
    """

    def __init__(
        self,
        path: str | Path,
        header: CaptureHeader,
        *,
        dtype: np.dtype,
        centre_lines: bool = False,
        moving: bool = False,
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
        self._lines, self._moving = camera.lines() if centre_lines else 0, moving
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
        held = unfinished.header, unfinished.dtype, unfinished.plan()
        there = _recording_table(*held, lines=unfinished.holds_lines, moving=unfinished.moving)
        kinds = {"lines": bool(self._lines), "moving": self._moving}
        wanted = _recording_table(self.header, self._dtype, self._plan, **kinds)
        if others := differences(there, wanted):
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
                write_label(self._file, format=FORMAT, version=self._version(), header=self.header)
                if self._plan is not None:
                    write_plan(self._file, self._plan)
                # The checksum finds damage that the compression would decode to a different picture.
                parts = {"frames": (self._shape, self._dtype)}
                if self._lines:
                    parts["centre_lines"] = (len(ROWS), self._lines), np.dtype(float)
                for name, (shape, dtype) in parts.items():
                    self._file.create_dataset(
                        name,
                        (0, *shape),
                        dtype,
                        maxshape=(None, *shape),
                        chunks=(1, *shape),
                        fletcher32=True,
                        **hdf5plugin.Blosc(cname="zstd", clevel=1, shuffle=hdf5plugin.Blosc.BITSHUFFLE),
                    )
                columns = self._per_frame | (dict.fromkeys(_MORE, ()) if self._version() > 1 else {})
                if self._moving:
                    self._file.create_dataset("stage_reports", (0, 2), float, maxshape=(None, 2), chunks=(256, 2))
                for name, shape in columns.items():
                    kind, chunks = _MORE.get(name, bool if name == "laser_on" else float), (256, *shape)
                    # No checksum: a kill while 256 rows are rewritten would then lose them all, not only the last one.
                    self._file.create_dataset(name, (0, *shape), kind, maxshape=(None, *shape), chunks=chunks)
                self._arrays = _arrays(self._file)
                for frame in unfinished:
                    self._store(frame)
            _cut_to_used(fresh)
            os.replace(fresh, self._part)
        finally:
            fresh.unlink(missing_ok=True)

    def _version(self) -> int:
        return VERSION if self._lines or self._moving else 1

    def __len__(self) -> int:
        """Number of complete frames written."""
        return len(self._arrays["time_s"])

    def append(self, frame: Frame) -> None:
        """Store one frame; once this returns, the frame survives the end of the program.

        ImageError where what was seen has another size or type than the capture, or a laser frame is an image where the
        capture has centre lines; CaptureError where stage position,
        exposure, time or pose is not finite, the exposure is negative, the time is before the last frame's, or the pose
        is no rotation with a shift (4, 4); OutputError where storage fails, the frames before being kept.
        """
        self._require_fitting(frame)
        if frame.speed_mm_per_s and not self._moving:
            raise CaptureError(f"a frame moves by {frame.speed_mm_per_s:g} mm/s in a capture of a stage at rest")
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

    def place(self, stage_mm: np.ndarray, speed_mm_per_s: np.ndarray, reports: np.ndarray) -> None:
        """Correct positions and speeds (N,) of the frames, once the stage's ``reports`` (M, 2) are complete."""
        with self._storage():
            for name, values in (
                ("stage_mm", stage_mm),
                ("speed_mm_per_s", speed_mm_per_s),
                ("stage_reports", reports),
            ):
                dataset = self._arrays[name]
                dataset.resize(len(values), axis=0)
                dataset[...] = values
                dataset.flush()

    def _require_fitting(self, frame: Frame) -> None:
        seen = frame.seen
        if isinstance(seen, Stripe):
            if len(seen.centre_px) != self._lines:
                held = f"centre lines of {self._lines} profile lines" if self._lines else "images"
                raise ImageError(f"frame is a centre line of {len(seen.centre_px)} lines, the capture holds {held}")
        elif seen.shape != self._shape or seen.dtype != self._dtype:
            raise ImageError(f"frame is {seen.shape} {seen.dtype}, the capture holds {self._shape} {self._dtype}")
        elif self._lines and frame.laser_on:
            raise ImageError("frame is an image with the laser on, the capture holds centre lines for these")

    def _store(self, frame: Frame) -> None:
        self._claim_space()
        pose = np.full((4, 4), np.nan) if frame.pose is None else frame.pose
        values: dict[str, object] = {"stage_mm": frame.stage_mm, "pose": pose, "laser_on": frame.laser_on}
        if self._version() > 1:
            encoder = np.nan if frame.encoder is None else frame.encoder
            values |= {"has_image": not isinstance(frame.seen, Stripe), "encoder": encoder}
            values |= {"speed_mm_per_s": frame.speed_mm_per_s}
        if isinstance(frame.seen, Stripe):
            kept, seen = "centre_lines", rows_of(frame.seen)
        else:
            kept, seen = "frames", frame.seen
        if _COVARIANCE in self._per_frame:
            values[_COVARIANCE] = np.full((6, 6), np.nan) if frame.pose_covariance is None else frame.pose_covariance
        # The time comes last: by its number frames are counted.
        values |= {"exposure_ms": frame.exposure_ms, "time_s": frame.time_s}
        count = len(self)
        # A piece of a dataset that is not written takes no space.
        for name in ("frames", "centre_lines") if self._lines else ("frames",):
            dataset = self._arrays[name]
            dataset.resize(count + 1, axis=0)
            if name == kept:
                dataset[count] = seen
            dataset.flush()
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
    has_image : (N,) bool
        Whether a frame is an image, rather than a centre line.
    encoder : (N,) float64
        Count of an encoder at each frame; NaN where there is none.
    speed_mm_per_s : (N,) float64
        Speed of the stage at each frame, positive where positions grow; 0 at rest.
    stage_reports : (M, 2) float64
        What a stage reported while it moved: time in s, as of ``time_s``, and position in mm.

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
        self.holds_lines = "centre_lines" in self.file
        self.moving = "stage_reports" in self.file
        more = {
            name: self._dataset(name, (), "b" if kind is bool else "f")
            for name, kind in _MORE.items()
            if name in self.file
        }
        counted = [images, *columns.values(), *more.values()]
        if self.holds_lines:
            self._lines = self._dataset("centre_lines", (len(ROWS), camera.lines()), "f")
            if self._lines.chunks != (1, *self._lines.shape[1:]):
                raise CaptureError(f"{self.path} is damaged: centre lines are in chunks of {self._lines.chunks}")
            counted.append(self._lines)
        self._count = min(map(len, counted))
        for dataset, name in zip(more.values(), more, strict=True):
            require_small_chunks(dataset, name, path=self.path)
        known = {name: dataset[: self._count] for name, dataset in more.items()}
        self.has_image = known.get("has_image", np.ones(self._count, bool))
        self.encoder = known.get("encoder", np.full(self._count, np.nan))
        self.speed_mm_per_s = known.get("speed_mm_per_s", np.zeros(self._count))
        self.stage_reports = np.empty((0, 2))
        if self.moving:
            reports = self._dataset("stage_reports", (2,), "f")
            require_small_chunks(reports, "stage_reports", path=self.path)
            self.stage_reports = reports[:]
        if not (np.isfinite(self.speed_mm_per_s).all() and np.isfinite(self.stage_reports).all()):
            raise CaptureError(f"{self.path} holds speeds or reports of the stage that are not finite")
        if self.holds_lines:
            self._require_stored(self._lines, int(np.count_nonzero(~self.has_image)), "centre lines")
        self._require_stored(images, int(np.count_nonzero(self.has_image)), "images")
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
            for name in (*_PER_FRAME, *_MORE, *([] if self.pose_covariance is None else [_COVARIANCE])):
                setattr(self, name, getattr(self, name)[: self._count])
        if (np.diff(self.time_s) < 0).any():
            raise CaptureError(f"{self.path} holds times that run backwards")

    def _require_stored(self, parts: h5py.Dataset, count: int, called: str) -> None:
        # HDF5 shows chunks that were never stored as zeros.
        if parts.id.get_num_chunks() < count:
            raise CaptureError(f"{self.path} is damaged: it holds {parts.id.get_num_chunks()} of {count} {called}")

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

    def seen(self, index: int) -> Seen:
        """Image (H, W) or centre line of a frame; raises CaptureError where its data are damaged."""
        if not 0 <= index < self._count:
            raise IndexError(f"frame {index} of {self._count}")
        try:
            if self.has_image[index]:
                return self._images[index]
            rows = self._lines[index]
        except _DAMAGE as error:
            raise CaptureError(f"frame {index} of {self.path} cannot be read: the file is damaged ({error})") from error
        return self._stripe(rows, index)

    def _stripe(self, rows: np.ndarray, index: int) -> Stripe:
        centre, amplitude, width, status = rows
        along = self.header.sensor.camera.stripe_along
        length = self._images.shape[1 if along == "width" else 2]
        good = status == StripeStatus.OK
        known = np.isin(status, list(StripeStatus)).all() and np.array_equal(good, np.isfinite(centre))
        if not known or (centre[good] < -0.5).any() or (centre[good] > length - 0.5).any():
            raise CaptureError(
                f"frame {index} of {self.path} is damaged: its centre line has places beyond 0 to {length - 1} px, or "
                "none where its status says that there is one"
            )
        return Stripe(centre, amplitude.astype(np.float32), width.astype(np.float32), status.astype(np.uint8), along)

    def image(self, index: int) -> np.ndarray:
        """Image (H, W) of a frame; ImageError where it is a centre line, CaptureError where its data are damaged."""
        return image_of(self.seen(index), f"frame {index} of {self.path.name}")

    def __getitem__(self, index: int) -> Frame:
        """A frame with everything known about it; raises CaptureError where its data are damaged."""
        index = index + self._count if index < 0 else index
        seen = self.seen(index)
        columns = (self.stage_mm, self.laser_on, self.exposure_ms, self.time_s)
        pose = self.pose[index] if np.isfinite(self.pose[index]).all() else None
        own = None if self.pose_covariance is None else self.pose_covariance[index]
        covariance = own if own is not None and np.isfinite(own).all() else None
        encoder = self.encoder[index].item() if np.isfinite(self.encoder[index]) else None
        known = {"pose": pose, "encoder": encoder, "speed_mm_per_s": self.speed_mm_per_s[index].item()}
        known["pose_covariance"] = covariance
        return Frame(seen, *(column[index].item() for column in columns), **known)

    def frames(self, *, laser_on: bool | None = None) -> Iterator[tuple[int, np.ndarray]]:
        """Index and image of all frames, or only of those with the laser on or off; ImageError at a centre line."""
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
