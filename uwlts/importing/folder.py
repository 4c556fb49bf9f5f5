"""A folder of images becomes a capture."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import uwlts
from uwlts.capture import CaptureHeader, CaptureWriter, Frame, part_path
from uwlts.errors import DescriptionError, ImageError
from uwlts.files import refuse_unsuitable
from uwlts.importing.content import Content, check_size
from uwlts.importing.description import NAME, ImportDescription, capture_header, described_sensor, read_description
from uwlts.importing.images import bits_of, grey_values, one_channel, read_image, without_background
from uwlts.importing.matching import Matched, match, read_rows
from uwlts.importing.positions import PlannedFrame, planned_frames, stage_remark
from uwlts.sensor import Sensor

_UNKNOWN = 0.0
"""Exposure and time of images of which nobody knows them; the provenance says so."""


@dataclass(frozen=True)
class Imported:
    """What was imported: number of laser and lamp images, and what is doubtful about them."""

    laser: int
    lamp: int
    warnings: tuple[str, ...]


def import_folder(
    folder: Path,
    out: Path,
    *,
    description: Path | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Imported:
    """Write the images of a folder as a capture, whole or not at all.

    Where laser images have a background, all images are stored with 16 bit, the laser images as the difference plus
    2^bits: the sign of the noise about zero is part of the evidence.

    Parameters
    ----------
    folder : Path
        The images: PNG, TIFF, BMP or JPEG, in it or in folders below it.
    out : Path
        Capture to write.
    description : Path, optional
        TOML file of an `ImportDescription`; import.toml in the folder unless given.
    overwrite : bool
        Replace an existing capture.
    progress : callable
        Called with the number of images done and of all.

    Raises
    ------
    DescriptionError
        The description, or a file it names, is missing, wrong or contradictory.
    ImageError
        The folder holds no image; an image is foreign, truncated, of another size or depth than the others, has an
        alpha channel, is of several colours without a chosen one, is saturated all over; or all are black.
    OutputError
        The capture cannot be written.
    """
    refuse_unsuitable(out, overwrite=overwrite)
    if not folder.is_dir():
        raise ImageError(f"no folder at {folder}")
    path = folder / NAME if description is None else description
    told = read_description(path)
    sensor = described_sensor(told, beside=path.parent)
    rows = None if told.table is None else read_rows(path.parent / told.table)
    matched = match(folder, told, rows)
    frames = planned_frames(folder, told, matched, in_table=rows is not None)
    reader = _Reader(told, sensor, folder)
    first, bits = reader.image(frames[0].path, laser_on=frames[0].laser_on)
    zero = _zero_dn(told, frames, bits)
    saturation = 2**bits - 1 if told.saturation_dn is None else told.saturation_dn
    header = capture_header(
        told, sensor, beside=path.parent, name=folder.resolve().name, saturation_dn=saturation + zero,
        remarks=_remarks(told, frames, folder, bits=bits, zero_dn=zero),
    )  # fmt: skip
    if header.saturation_dn - zero > np.iinfo(first.dtype).max:
        raise DescriptionError(
            f"saturation_dn is {header.saturation_dn - zero}; images of {first.dtype} have no such value"
        )
    content = Content(header.sensor, header.saturation_dn - zero, header.target is not None)
    _write(out, header, frames, reader, content, zero_dn=zero, overwrite=overwrite, progress=progress)
    return Imported(len(matched.laser), len(matched.lamp), (*content.verdict(), *_unmatched(matched)))


def _zero_dn(told: ImportDescription, frames: list[PlannedFrame], bits: int) -> int:
    """What is added to a difference; 0 where nothing is subtracted."""
    if all(frame.background is None for frame in frames):
        return 0
    if told.header is not None:
        raise DescriptionError(
            "a background is to be subtracted, but the header is that of a finished capture: leave out one of the two"
        )
    if bits == 16:
        raise DescriptionError(
            "a background is to be subtracted, but 16 bits leave no room for its sign: give the bits that the camera "
            "used, or leave the background out"
        )
    return 2**bits


class _Reader:
    """Reads images as grey values that all have the size and depth of the first; keeps the last background."""

    def __init__(self, told: ImportDescription, sensor: Sensor, folder: Path):
        self._told, self._sensor, self._folder = told, sensor, folder
        self.dtype: np.dtype | None = None
        self._kept: tuple[Path | None, np.ndarray | None] = None, None

    def image(self, path: Path, *, laser_on: bool) -> tuple[np.ndarray, int]:
        """Grey image (H, W) and its bits; ImageError where it is not like the others."""
        told, name = self._told, path.relative_to(self._folder).as_posix()
        raw = read_image(path)
        check_size(raw, self._sensor, name=name, first=self.dtype is None)
        if self.dtype not in (None, raw.dtype):
            raise ImageError(f"{name} is of {raw.dtype}, the images before it of {self.dtype}")
        channel = told.channel if laser_on or told.lamp_channel is None else told.lamp_channel
        grey = one_channel(raw, channel, name=name)
        # A header tells no bits, and grey values that a capture held fit in it.
        bits = 8 * raw.itemsize if told.header is not None else bits_of(raw, told.bits, name=name)
        self.dtype = raw.dtype
        return grey_values(grey, bits=bits, aligned=told.aligned, name=name), bits

    def background(self, path: Path) -> np.ndarray:
        """Grey image (H, W) without laser, in the laser's channel."""
        if self._kept[0] != path:
            self._kept = path, self.image(path, laser_on=True)[0]
        return self._kept[1]


def _write(
    out: Path, header: CaptureHeader, frames: list[PlannedFrame], reader: _Reader, content: Content, *,
    zero_dn: int, overwrite: bool, progress: Callable[[int, int], None],
) -> None:  # fmt: skip
    dtype = np.dtype(np.uint16) if zero_dn else reader.dtype
    writer = CaptureWriter(out, header, dtype=dtype, overwrite=overwrite)
    try:
        with writer:
            for number, frame in enumerate(frames):
                image, _ = reader.image(frame.path, laser_on=frame.laser_on)
                content.look(image, laser_on=frame.laser_on, name=frame.path.name)
                if frame.background is not None:
                    dark = reader.background(frame.background)
                    image = without_background(image, dark, zero_dn=zero_dn)
                if frame.laser_on:
                    content.look_for_stripe(image)
                writer.append(_frame(image.astype(dtype, copy=False), frame))
                progress(number + 1, len(frames))
            content.refuse_black()
    except BaseException:
        # Unlike a recording an import can be made again: half of one is of no use.
        part_path(out).unlink(missing_ok=True)
        raise


def _frame(image: np.ndarray, planned: PlannedFrame) -> Frame:
    exposure, time = (_UNKNOWN if value is None else value for value in (planned.exposure_ms, planned.time_s))
    return Frame(image, planned.stage_mm, planned.laser_on, exposure, time, planned.pose)


def _remarks(
    told: ImportDescription, frames: list[PlannedFrame], folder: Path, *, bits: int, zero_dn: int
) -> dict[str, object]:
    """What the capture says of its origin."""
    remarks: dict[str, object] = {
        "source": "imported images", "uwlts": uwlts.__version__, "folder": folder.resolve().name, "bits": bits,
        "stage": stage_remark(told),
    }  # fmt: skip
    remarks |= {key: getattr(told, key) for key in ("channel", "lamp_channel", "intrinsics") if getattr(told, key)}
    if zero_dn:
        remarks["background"] = f"subtracted from the laser images, {zero_dn} added"
    for name, values in (("exposure", [f.exposure_ms for f in frames]), ("time", [f.time_s for f in frames])):
        if None in values:
            remarks[name] = "not known of all images, stored as 0 where it is missing"
    return remarks


def _unmatched(matched: Matched) -> list[str]:
    if not matched.unmatched:
        return []
    few = ", ".join(matched.unmatched[:3])
    return [f"{len(matched.unmatched)} images of the folder are left out, as nothing tells what they are: {few}"]
