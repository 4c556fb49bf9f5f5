"""The capture file: images of a scan with everything known about them, written frame by frame.

An HDF5 file with ``frames (N, H, W)`` (8 or 16 bit, one chunk per frame, Blosc zstd with bit shuffle), per frame
``stage_mm``, ``pose`` (4, 4), ``laser_on``, ``exposure_ms`` and ``time_s``, and JSON attributes for sensor, medium,
target, artefact and provenance. Nothing in it is ever executed, and real and synthetic captures look the same.

While it is being recorded the file is called ``NAME.part`` and every frame is flushed in HDF5's single-writer mode, so
an interrupted recording keeps all its complete frames; closing it gives it its name.
"""

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import h5py
import hdf5plugin
import numpy as np

from uwlts.errors import CaptureError, ImageError, OutputError
from uwlts.sensor import Description, Medium, Sensor

FORMAT = "uwlts-capture"
VERSION = 1
_PER_FRAME = {"stage_mm": (), "pose": (4, 4), "laser_on": (), "exposure_ms": (), "time_s": ()}


class CaptureHeader(Description):
    """What holds for all frames of a capture.

    ``stage_direction`` is the nominal unit direction in which the stage moves the sensor, in the OCS; ``target`` and
    ``artefact`` describe what was before the sensor, as known to whoever recorded it; ``saturation_dn`` is the grey
    value at which pixels clip.
    """

    name: str
    sensor: Sensor
    medium_name: str
    medium: Medium
    stage_direction: tuple[float, float, float]
    saturation_dn: int
    target: dict[str, Any] | None = None
    artefact: dict[str, Any] | None = None
    provenance: dict[str, Any] = {}


@dataclass(frozen=True)
class Frame:
    """One image (H, W) with its stage position in mm, pose (4, 4) or NaN, light, exposure in ms and time in s."""

    image: np.ndarray
    stage_mm: float
    laser_on: bool
    exposure_ms: float
    time_s: float
    pose: np.ndarray | None = None


def part_path(path: Path) -> Path:
    """Name of an unfinished recording of ``path``."""
    return path.with_name(path.name + ".part")


def _storage_failed(path: Path, error: OSError) -> OutputError:
    reason = os.strerror(error.errno) if error.errno else str(error)
    return OutputError(f"cannot write {path}: {reason}; frames written so far are kept in {part_path(path).name}")


class CaptureWriter:
    """Records a capture. A context manager: leaving it normally finishes the file, an exception keeps the part.

    Raises
    ------
    OutputError
        The file exists (give ``overwrite``), a part is left over (give ``resume`` or ``overwrite``), or storage fails.
    CaptureError
        ``resume`` of a part that belongs to another recording.
    """

    def __init__(
        self, path: str | Path, header: CaptureHeader, *, dtype: np.dtype, overwrite: bool = False, resume: bool = False
    ):
        self.path, self.header = Path(path), header
        self._part = part_path(self.path)
        if self.path.exists() and not overwrite:
            raise OutputError(f"{self.path} exists already; give another name, or --overwrite to replace it")
        if not self.path.parent.is_dir():
            raise OutputError(f"the folder {self.path.parent} does not exist; create it first")
        camera = header.sensor.camera
        self._shape = (camera.height_px, camera.width_px)
        try:
            if self._part.exists() and resume:
                self._file = self._continue()
            elif self._part.exists() and not overwrite:
                raise OutputError(f"{self._part} is left from an interrupted run; give --resume to go on or --overwrite")
            else:
                self._file = self._create(self._part, np.dtype(dtype))
            self._file.swmr_mode = True
        except OSError as error:
            raise _storage_failed(self.path, error) from error

    def _create(self, path: Path, dtype: np.dtype) -> h5py.File:
        file = h5py.File(path, "w", libver="latest")
        file.attrs.update(format=FORMAT, version=VERSION, header=self.header.model_dump_json())
        file.create_dataset(
            "frames", (0, *self._shape), dtype, maxshape=(None, *self._shape), chunks=(1, *self._shape),
            **hdf5plugin.Blosc(cname="zstd", clevel=1, shuffle=hdf5plugin.Blosc.BITSHUFFLE),
        )  # fmt: skip
        for name, shape in _PER_FRAME.items():
            kind = bool if name == "laser_on" else float
            file.create_dataset(name, (0, *shape), kind, maxshape=(None, *shape), chunks=(256, *shape))
        return file

    def _continue(self) -> h5py.File:
        """A fresh part with the complete frames of the one left over (HDF5 cannot append to a killed writer's file)."""
        with Capture(self._part) as unfinished:
            if unfinished.header != self.header:
                raise CaptureError(f"{self._part} belongs to another recording; give --overwrite to start afresh")
            old, count = unfinished.file, len(unfinished)
            aside = self._part.with_suffix(".resumed")
            file = self._create(aside, old["frames"].dtype)
            for name in _PER_FRAME:
                file[name].resize(count, axis=0)
                file[name][:] = old[name][:count]
            file["frames"].resize(count, axis=0)
            for index in range(count):
                mask, chunk = old["frames"].id.read_direct_chunk((index, 0, 0))
                file["frames"].id.write_direct_chunk((index, 0, 0), chunk, mask)
        os.replace(aside, self._part)
        return file

    def __len__(self) -> int:
        """Number of complete frames written."""
        return self._file["time_s"].shape[0]

    def append(self, frame: Frame) -> None:
        """Store one frame; it is complete and safe on return."""
        if frame.image.shape != self._shape or frame.image.dtype != self._file["frames"].dtype:
            raise ImageError(
                f"frame is {frame.image.shape} {frame.image.dtype}, the capture holds {self._shape} "
                f"{self._file['frames'].dtype}"
            )
        pose = np.full((4, 4), np.nan) if frame.pose is None else frame.pose
        values = {"frames": frame.image, "stage_mm": frame.stage_mm, "pose": pose, "laser_on": frame.laser_on}
        values |= {"exposure_ms": frame.exposure_ms, "time_s": frame.time_s}
        count = len(self)
        try:
            for name, value in values.items():
                dataset = self._file[name]
                dataset.resize(count + 1, axis=0)
                dataset[count] = value
                dataset.flush()
        except OSError as error:
            raise _storage_failed(self.path, error) from error

    def __enter__(self) -> "CaptureWriter":
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        try:
            self._file.close()
            if kind is None:
                os.replace(self._part, self.path)
        except OSError as error:
            raise _storage_failed(self.path, error) from error


class Capture:
    """A capture opened for reading: per-frame arrays in memory, images read on demand.

    Raises
    ------
    CaptureError
        The file is missing, foreign, truncated, of a newer version, or contradicts itself.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        if not self.path.is_file():
            raise CaptureError(f"no capture at {self.path}")
        try:
            self.file = h5py.File(self.path, "r", swmr=True, libver="latest")
        except OSError as error:
            raise CaptureError(f"{self.path} is not a capture, or is truncated: HDF5 cannot open it") from error
        try:
            self._read_header()
        except BaseException:
            self.file.close()
            raise

    def _read_header(self) -> None:
        attributes = self.file.attrs
        found = attributes.get("format")
        if found != FORMAT:
            raise CaptureError(f"{self.path} is HDF5 but not a capture: format is {found!r}, expected '{FORMAT}'")
        if attributes["version"] > VERSION:
            raise CaptureError(
                f"{self.path} has version {attributes['version']}; this program reads up to {VERSION}: update it"
            )
        try:
            self.header = CaptureHeader.model_validate(json.loads(attributes["header"]))
            counts = [self.file[name].shape[0] for name in ("frames", *_PER_FRAME)]
            self._count = min(counts)
            self.stage_mm, self.pose, self.laser_on, self.exposure_ms, self.time_s = (
                self.file[name][: self._count] for name in _PER_FRAME
            )
        except (KeyError, ValueError, OSError) as error:
            raise CaptureError(f"{self.path} is damaged: {error}") from error
        camera = self.header.sensor.camera
        if self.file["frames"].shape[1:] != (camera.height_px, camera.width_px):
            raise CaptureError(
                f"{self.path} holds images of {self.file['frames'].shape[1:]} rows and columns, its sensor has "
                f"{(camera.height_px, camera.width_px)}"
            )
        if not (np.isfinite(self.stage_mm).all() and np.isfinite(self.exposure_ms).all()):
            raise CaptureError(f"{self.path} holds stage positions or exposures that are not finite")

    def __len__(self) -> int:
        return self._count

    @property
    def finished(self) -> bool:
        """Whether the recording was closed, rather than interrupted."""
        return self.path.suffix != ".part"

    def image(self, index: int) -> np.ndarray:
        """Image (H, W) of a frame; raises CaptureError where its data are damaged."""
        if not 0 <= index < self._count:
            raise IndexError(f"frame {index} of {self._count}")
        try:
            return self.file["frames"][index]
        except OSError as error:
            raise CaptureError(f"frame {index} of {self.path} cannot be read: the file is damaged") from error

    def frames(self, *, laser_on: bool | None = None) -> Iterator[tuple[int, np.ndarray]]:
        """Index and image of all frames, or only of those with the laser on or off."""
        for index in range(self._count):
            if laser_on is None or bool(self.laser_on[index]) == laser_on:
                yield index, self.image(index)

    def close(self) -> None:
        """Close the file."""
        self.file.close()

    def __enter__(self) -> "Capture":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
