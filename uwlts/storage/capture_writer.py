"""Writing of capture files frame by frame, so that an interrupted recording keeps all its complete frames."""

import math
import os
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from io import BufferedReader
from pathlib import Path
from typing import cast

import h5py
import hdf5plugin
import numpy as np

from uwlts.errors import CaptureError, ImageError, OutputError
from uwlts.files.json_files import describe_differences
from uwlts.files.writing import refuse_unsuitable
from uwlts.model.sensor import CaptureHeader, Table, is_rigid
from uwlts.storage.capture import (
    CAPTURES,
    COVARIANCE,
    FORMAT,
    PER_FRAME,
    POSE_ROUNDED,
    SPEED,
    VERSION,
    Capture,
    Frame,
    part_path,
    require_covariances,
)
from uwlts.storage.hdf5_file import claim_space, forget_plan, truncate, write_label, write_plan

try:
    import fcntl
except ImportError:
    fcntl = None


class CaptureWriter(AbstractContextManager["CaptureWriter"]):
    """Recording of a capture, as a context manager: a normal exit finishes the file, an exception keeps the part.

    ``header`` describes all frames, ``dtype`` is that of their images, uint8 or uint16. With ``moving``, frames have a
    speed, and `place` adds the stage's reports. With ``covariances``, they may have a covariance of their
    pose. ``plan`` describes the recording as JSON, and is kept in the part but not in the finished capture.
    ``overwrite`` replaces an existing capture or part, ``resume`` continues a part.

    OutputError if the file exists or is an input of the running command, a part exists, or writing fails; CaptureError
    if the part to resume is damaged, or has another header or plan.
    """

    def __init__(
        self,
        path: str | Path,
        header: CaptureHeader,
        *,
        dtype: np.dtype,
        moving: bool = False,
        plan: Table | None = None,
        covariances: bool = False,
        overwrite: bool = False,
        resume: bool = False,
    ):
        self.path, self.header, self._plan = Path(path), header, plan
        self._last_s = -math.inf
        self._part = part_path(self.path)
        camera = header.sensor.camera
        self._shape, self._dtype = (camera.height_px, camera.width_px), np.dtype(dtype)
        self._frame_bytes = camera.height_px * camera.width_px * self._dtype.itemsize
        self._moving = moving
        self._columns: dict[str, tuple[tuple[int, ...], type]] = {COVARIANCE: ((6, 6), float)} if covariances else {}
        self._columns |= {SPEED: ((), float)} if moving else {}
        # The time is written last: its length is the number of frames.
        self._columns |= PER_FRAME
        if self._dtype not in (np.uint8, np.uint16):
            raise ImageError(f"a capture holds images of uint8 or uint16, not of {self._dtype}")
        with self._storage():
            refuse_unsuitable(self.path, overwrite=overwrite, endings=CAPTURES)
            if self._part.exists():
                _lock(self._part).close()
                if not (resume or overwrite):
                    raise OutputError(
                        f"{self._part} is left from an interrupted run; give `resume` to continue it or `overwrite`"
                    )
            with self._open_part() if resume and self._part.exists() else nullcontext(()) as unfinished:
                self._begin(unfinished)
            # Without a lock, so that readers cannot stop a running recording.
            self._file = h5py.File(self._part, "r+", libver="latest", locking=False)
            self._file.swmr_mode = True
            self._locked = _lock(self._part)
            self._arrays = _list_data_sets(self._file)

    def _open_part(self) -> "Capture":
        """Open the unfinished recording to continue; raises CaptureError if it is not one of this capture."""
        try:
            unfinished = Capture(self._part)
        except CaptureError as error:
            raise CaptureError(f"cannot resume: {error}; give `overwrite` to start again") from error
        there = _dump_recording(unfinished.header, unfinished.dtype, unfinished.plan(), moving=unfinished.moving)
        wanted = _dump_recording(self.header, self._dtype, self._plan, moving=self._moving)
        if others := describe_differences(there, wanted):
            unfinished.close()
            raise CaptureError(
                f"{self._part} belongs to another recording: {others}. Continue with the plan of that one, give "
                "another name, or `overwrite` to start again"
            )
        return unfinished

    def _begin(self, unfinished: "Capture | Sequence[Frame]") -> None:
        """Create a valid part, empty or with the complete frames of the unfinished one.

        HDF5 cannot append to a killed writer's file, so a new file is written. It has a temporary name, so that a run
        that is killed meanwhile leaves the old part.
        """
        fresh = self._part.with_suffix(".fresh")
        try:
            with h5py.File(fresh, "w", libver="latest", locking=False) as self._file:
                claim_space(self._file, self._frame_bytes)
                write_label(self._file, file_format=FORMAT, version=VERSION if self._moving else 1, header=self.header)
                if self._plan is not None:
                    write_plan(self._file, self._plan)
                # The checksum detects damage that would otherwise be decompressed to another image.
                self._file.create_dataset(
                    "frames",
                    (0, *self._shape),
                    self._dtype,
                    maxshape=(None, *self._shape),
                    chunks=(1, *self._shape),
                    fletcher32=True,
                    **hdf5plugin.Blosc(cname="zstd", clevel=1, shuffle=hdf5plugin.Blosc.BITSHUFFLE),
                )
                if self._moving:
                    self._file.create_dataset("stage_reports", (0, 2), float, maxshape=(None, 2), chunks=(256, 2))
                for name, (shape, kind) in self._columns.items():
                    chunks = 256, *shape
                    # No checksum: if a kill interrupts the rewriting of a chunk, it would lose 256 rows instead of the
                    # last one.
                    self._file.create_dataset(name, (0, *shape), kind, maxshape=(None, *shape), chunks=chunks)
                self._arrays = _list_data_sets(self._file)
                for frame in unfinished:
                    self._store(frame)
            truncate(fresh)
            os.replace(fresh, self._part)
        finally:
            fresh.unlink(missing_ok=True)

    def __len__(self) -> int:
        """Return the number of complete frames written."""
        return len(self._arrays["time_s"])

    def append(self, frame: Frame) -> None:
        """Store one frame; once this returns, the frame survives the end of the program.

        Raises
        ------
        ImageError
            The frame has another size or type than the capture.
        CaptureError
            Stage position, exposure, time or pose is not finite, or the exposure is negative. The time is before that
            of the last frame. The pose is not a rotation with a shift (4, 4).
        OutputError
            Writing fails; earlier frames are kept.
        """
        if (image := frame.image).shape != self._shape or image.dtype != self._dtype:
            raise ImageError(f"frame is {image.shape} {image.dtype}, the capture holds {self._shape} {self._dtype}")
        if frame.speed_mm_per_s and not self._moving:
            raise CaptureError(f"a frame moves by {frame.speed_mm_per_s:g} mm/s in a capture of a stage at rest")
        if not np.isfinite([frame.stage_mm, frame.exposure_ms, frame.time_s]).all() or frame.exposure_ms < 0:
            raise CaptureError(
                f"a frame at stage position {frame.stage_mm} mm, exposure {frame.exposure_ms} ms and time "
                f"{frame.time_s} s cannot be stored: all three must be finite, the exposure not negative"
            )
        if frame.time_s < self._last_s:
            raise CaptureError(
                f"a frame at {frame.time_s} s cannot follow one at {self._last_s} s: give increasing times"
            )
        if frame.pose is not None and (np.shape(frame.pose) != (4, 4) or not np.isfinite(frame.pose).all()):
            raise CaptureError(f"a pose must be a finite array (4, 4); found {frame.pose}")
        if frame.pose is not None and not is_rigid(frame.pose, within=POSE_ROUNDED):
            raise CaptureError(f"a pose must be a rotation, a shift and 0 0 0 1; found {frame.pose.tolist()}")
        if frame.pose_covariance is not None:
            if COVARIANCE not in self._columns:
                raise CaptureError("the capture was begun without covariances of poses: begin it with covariances=True")
            require_covariances(np.asarray(frame.pose_covariance)[None], self.path)
        with self._storage():
            self._store(frame)

    def place(self, stage_mm: np.ndarray, speed_mm_per_s: np.ndarray, reports: np.ndarray) -> None:
        """Correct positions and speeds (N,) of the frames when the stage's ``reports`` (M, 2) are complete."""
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

    def _store(self, frame: Frame) -> None:
        claim_space(self._file, self._frame_bytes)
        known, values = vars(frame), {"frames": frame.image}
        values |= {
            name: np.full(shape, np.nan) if known[name] is None else known[name]
            for name, (shape, _) in self._columns.items()
        }
        count = len(self)
        for name, value in values.items():
            dataset = self._arrays[name]
            dataset.resize(count + 1, axis=0)
            dataset[count] = value
            dataset.flush()
        self._last_s = frame.time_s

    @contextmanager
    def _storage(self) -> Iterator[None]:
        """Convert errors of the file system and of HDF5 to OutputError."""
        try:
            yield
        except (OSError, RuntimeError) as error:
            number = getattr(error, "errno", None)
            reason = os.strerror(number) if number else " ".join(str(error).split())
            kept = f"; complete frames are kept in {self._part.name}" if os.path.exists(self._part) else ""
            raise OutputError(f"cannot write {self.path}: {reason}{kept}") from error

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        with self._locked, self._storage():
            empty = len(self) == 0
            self._file.close()
            if kind is not None and empty:
                self._part.unlink()
            elif kind is None:
                if self._plan is not None:
                    forget_plan(self._part)
                truncate(self._part)
                os.replace(self._part, self.path)


def _lock(part: Path) -> BufferedReader:
    """Lock a part until the returned file is closed; raises OutputError if another process is recording it."""
    file = open(part, "rb")  # noqa: SIM115 - kept open as long as the lock
    try:
        if fcntl is not None:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        file.close()
        raise OutputError(f"another process is writing {part}; wait until it ends, or give another name") from error
    except OSError:
        pass  # a file system without locks
    return file


def _dump_recording(header: CaptureHeader, dtype: np.dtype, plan: Table | None, *, moving: bool) -> Table:
    """Return a description of a recording as JSON."""
    return {"plan": plan, "images": f"{dtype}{', moving' if moving else ''}", "header": header.model_dump(mode="json")}


def _list_data_sets(file: h5py.File) -> dict[str, h5py.Dataset]:
    """Return the datasets of a capture by name."""
    names = ("frames", "stage_reports", SPEED, COVARIANCE, *PER_FRAME)
    return {name: cast(h5py.Dataset, file[name]) for name in names if name in file}
