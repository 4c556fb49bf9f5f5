"""Import of a folder of images as a capture, with checks for black, saturated and stripe-free images."""

import math
from collections import defaultdict
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from uwlts._version import __version__
from uwlts.errors import DescriptionError, ImageError
from uwlts.files.writing import refuse_unsuitable
from uwlts.model.sensor import Sensor, Table
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.storage.capture import CAPTURES, Frame, part_path
from uwlts.storage.capture_writer import CaptureWriter
from uwlts.storage.image_file import ImageHeader, read_image
from uwlts.storage.import_.bag_images import is_bag, unpack_images
from uwlts.storage.import_.folder_description import (
    NAME,
    ImportDescription,
    capture_header,
    described_sensor,
    read_description,
)
from uwlts.storage.import_.grey_values import (
    bits_of,
    combine_clipped,
    demosaic,
    extract_channel,
    grey_values,
    is_formula,
    is_mosaic,
    subtract_background,
)
from uwlts.storage.import_.matching import ImageRow, match, planned_frames, read_rows, stage_remark
from uwlts.stripe.capture_stripes import BLACK, WHITE, find_stripe_direction, is_black

_SIZE_ADVICE = {
    (True, True): "the images are rotated by 90 deg: rotate them back, or exchange width_px and height_px of the "
    "sensor and check stripe_along",
    (True, False): "give the description of the sensor that took the images, or correct its width_px and height_px",
    (False, True): "it is rotated by 90 deg: rotate it back",
    (False, False): "leave it out (ignore), or import it on its own",
}
"""Advice on an image of another size than the sensor's, by whether it is the first, and whether it is rotated."""

_MOST_EXAMINED = 4  # images of each light in which a mosaic is looked for
_INVERTED = 3.0  # largest dark deviation from the median of a laser image, relative to the bright one
_MANY_LINES = 0.5  # fraction of the profile lines with clipped pixels: the stripe itself rather than reflections


class _Content:
    """Names of the images of one import by what was found in them, and the warnings that follow.

    ``saturation_dn`` is that of the files; ``target``: the description has a target.
    """

    def __init__(self, stripe_along: str, saturation_dn: int, *, target: bool):
        self._stripe_along, self._saturation_dn, self._target = stripe_along, saturation_dn, target
        self._found: dict[str, list[str]] = defaultdict(list)
        self._last: np.ndarray | None = None

    def add_image(self, image: np.ndarray, clipped: np.ndarray, *, light: str, name: str) -> None:
        """Note an image (H, W) and its ``clipped`` pixels (H, W); raises ImageError if most of it is saturated."""
        self._found[light].append(name)
        white = float(clipped.mean())
        if white > WHITE:
            raise ImageError(
                f"{name} is white: {100 * white:.0f} % of its pixels are saturated ({self._saturation_dn} DN): shorten "
                "the exposure, or leave it out (ignore)"
            )
        if is_black(image, self._saturation_dn):
            self._found[f"black {light}"].append(name)
            return
        examined = len(self._found[light]) - len(self._found[f"black {light}"]) <= _MOST_EXAMINED
        found: dict[str, object] = {"mosaic": examined and is_mosaic(image)}
        if light == "laser":
            low, middle, high = np.percentile(image, (0.1, 50, 99.9))
            lines = clipped.any(axis=1 if self._stripe_along == "height" else 0)
            found |= {"inverted": middle - low > _INVERTED * (high - middle), "clipped": lines.mean() > _MANY_LINES}
            found |= {"repeated": self._last is not None and np.array_equal(image, self._last)}
            self._last = image
        for what, holds in found.items():
            self._found[what] += [name] if holds else []

    def find_stripe(self, image: np.ndarray, name: str, *, saturation_dn: int) -> None:
        """Look for a stripe in a laser image (H, W) as it is stored."""
        direction = find_stripe_direction(image, stripe_along=self._stripe_along, saturation=saturation_dn)
        self._found[direction or "none"].append(name)

    def refuse_black(self) -> None:
        """Raise ImageError if all laser images are black, or all lamp images although there is a target."""
        lights = {"laser": " the channel that of its colour,"} | ({"lamp": ""} if self._target else {})
        for light, colour in lights.items():
            seen = len(self._found[light])
            if seen and len(self._found[f"black {light}"]) == seen:
                raise ImageError(
                    f"all {seen} {light} images are black, no pixel reaches {100 * BLACK:g} % of full scale: is "
                    f"the {light} on, the exposure long enough,{colour} bits right?"
                )

    def warnings(self) -> list[str]:
        """Return the warnings after all images were noted."""
        found, lasers = self._found, len(self._found["laser"])
        warnings = [
            f"{len(black)} of {len(found[light])} {light} images are black, such as {black[0]}"
            for light in ("laser", "lamp")
            if (black := found[f"black {light}"])
        ]
        if found["mosaic"]:
            warnings.append(
                f"{found['mosaic'][0]} looks like a raw Bayer image of a colour camera, whose pixels alternate between "
                "colours. This shifts the stripe: give the pattern and the laser's channel, such as bayer = 'RGGB' and "
                "channel = 'red', or convert the images to grey or colour in the camera"
            )
        if repeated := found["repeated"]:
            warnings.append(
                f"{len(repeated)} of {lasers} laser images are equal to the one before, such as {repeated[0]}: the "
                "camera or a copy repeated an image, so that positions may be wrong"
            )
        if 2 * len(found["inverted"]) > lasers and not self._target:
            warnings.append("the laser images have dark features on a bright ground: are their grey values inverted?")
        if found["clipped"]:
            warnings.append(
                f"{len(found['clipped'])} of {lasers} laser images are saturated on more than {100 * _MANY_LINES:g} % "
                "of their profile lines, where the stripe is less accurate: shorten the exposure"
            )
        if lasers and not found["along"]:
            advice = "check which images are laser images, the channel, and the exposure"
            if sideways := len(found["across"]):
                advice = f"in {sideways} of them one runs across: the images are rotated, or the sensor's "
                advice += f"stripe_along ('{self._stripe_along}') is wrong"
            warnings.append(f"no stripe in any of the {lasers} laser images: {advice}")
        elif (missing := lasers - len(found["along"])) > 0:
            warnings.append(f"{missing} of {lasers} laser images show no stripe")
        return warnings


@dataclass(frozen=True)
class Imported:
    """Result of an import: numbers of laser and lamp images, and warnings."""

    laser: int
    lamp: int
    warnings: tuple[str, ...]


def import_images(
    folder: str | Path,
    out: str | Path,
    *,
    description: str | Path | None = None,
    overwrite: bool = False,
    progress: ProgressListener = ignore_progress,
) -> Imported:
    """Convert a folder or a ROS bag of images of any camera to a capture, written completely or not at all.

    If laser images have a background, all images are stored with 16 bit. The laser images are then the difference plus
    2^bits, which keeps the sign of the noise about zero.

    Parameters
    ----------
    folder : str or Path
        Folder of PNG, TIFF, BMP or JPEG images; subfolders are included. Or a bag of ROS with images, which count as
        files TOPIC/NUMBER.png (or .jpg) with the times of their headers.
    out : str or Path
        Capture to write.
    description : str or Path, optional
        TOML file with sensor, medium, positions and the role of each image; by default import.toml in the folder. A
        bag needs one.
    overwrite : bool
        Replace an existing capture.
    progress : callable
        Called with the number of finished images and the total.

    Returns
    -------
    Imported
        Numbers of laser and lamp images, and warnings.

    Raises
    ------
    DescriptionError
        The description, or a file that it names, is missing, wrong or contradictory.
    ImageError
        The folder contains no image; an image is foreign, truncated or saturated, differs from the others in size or
        depth, has an alpha channel, or has several colours without a selected channel; or all images are black.
    OutputError
        The capture cannot be written.
    SetupError
        The library for bags is not installed.
    """
    folder, out = Path(folder), Path(out)
    refuse_unsuitable(out, overwrite=overwrite, endings=CAPTURES)
    if not (bag := is_bag(folder)) and not folder.is_dir():
        raise ImageError(f"no folder at {folder}")
    path = folder / NAME if description is None else Path(description)
    given, name = read_description(path), folder.resolve().name
    if not bag:
        return _import_folder(folder, name, out, given, path, overwrite, progress)
    with unpack_images(folder, given, out) as (unpacked, completed):
        return _import_folder(unpacked, name, out, completed, path, overwrite, progress)


def _import_folder(
    folder: Path,
    name: str,
    out: Path,
    given: ImportDescription,
    path: Path,
    overwrite: bool,
    progress: ProgressListener,
) -> Imported:
    """Convert a folder of images with a description, read from ``path``; ``name`` is that of the capture."""
    sensor = described_sensor(given, beside=path.parent)
    rows = None if given.table is None else read_rows(path.parent / given.table)
    matched = match(folder, given, rows)
    frames, doubts = planned_frames(given, matched, in_table=rows is not None)
    reader = _Reader(given, sensor, folder)
    *_, bits = reader.image(frames[0].file, laser_on=frames[0].light == "laser")
    subtracted = any(row.background is not None for row in frames)
    zero = _find_zero_dn(given, bits) if subtracted or reader.derives else 0
    saturation = 2**bits - 1 if given.saturation_dn is None else given.saturation_dn
    header = capture_header(
        given,
        sensor,
        beside=path.parent,
        name=name,
        saturation_dn=2 * zero - 1 if zero else saturation,
        remarks=_list_remarks(given, frames, name, bits=bits, zero_dn=zero),
    )
    saturation = reader.saturation_dn = saturation if given.header is None else header.saturation_dn
    if saturation > np.iinfo(reader.dtype).max:
        raise DescriptionError(f"saturation_dn is {saturation}; images of {reader.dtype} have no such value")
    in_time = _is_in_order(frames)
    content = _Content(header.sensor.camera.stripe_along, saturation, target=header.target is not None)
    dtype = np.dtype(np.uint16) if zero else reader.dtype
    writer = CaptureWriter(out, header, dtype=dtype, overwrite=overwrite)
    try:
        with writer:
            for number, row in enumerate(frames):
                # An unknown exposure or time is stored as 0, as stated in the provenance.
                exposure_ms, time_s = np.nan_to_num([row.exposure_ms, row.time_s if in_time else 0.0]).tolist()
                image = _store_image(row, reader, content, zero_dn=zero, saturation_dn=header.saturation_dn)
                image = image.astype(dtype, copy=False)
                writer.append(Frame(image, row.stage_mm, row.light == "laser", exposure_ms, time_s, row.pose))
                progress(number + 1, len(frames))
            content.refuse_black()
    except BaseException:
        # Unlike a recording, an import can be repeated: a partial one is useless.
        part_path(out).unlink(missing_ok=True)
        raise
    warnings = [*doubts, *content.warnings()]
    if not in_time:
        warnings.append(
            "the images are not in the order of their times, so times are left out; the table's order is kept"
        )
    if unmatched := matched.unmatched:
        few = ", ".join(unmatched[:3])
        warnings.append(f"{len(unmatched)} images of the folder are left out because nothing describes them: {few}")
    return Imported(len(matched.laser), len(matched.lamp), tuple(warnings))


def _store_image(
    row: ImageRow, reader: "_Reader", content: _Content, *, zero_dn: int, saturation_dn: int
) -> np.ndarray:
    """Read an image and add it to the ``content``; return it without its background, if one is subtracted."""
    laser_on = row.light == "laser"
    image, clipped, _ = reader.image(row.file, laser_on=laser_on)
    unsigned = np.maximum(image, 0).astype(reader.dtype, copy=False)
    name = Path(row.file).name
    content.add_image(unsigned, clipped, light="laser" if laser_on else "lamp", name=name)
    if not laser_on:
        return unsigned
    if zero_dn:
        unlit = np.zeros_like(image) if row.background is None else reader.background(row.background)
        unsigned = subtract_background(image, unlit, clipped, zero_dn=zero_dn)
    content.find_stripe(unsigned, name, saturation_dn=saturation_dn)
    return unsigned


def _is_in_order(frames: list[ImageRow]) -> bool:
    """Return whether the times of the images do not decrease; an unknown time counts as 0 s."""
    return bool((np.diff(np.nan_to_num([row.time_s for row in frames])) >= 0).all())


def _find_zero_dn(given: ImportDescription, bits: int) -> int:
    """Return the grey value of zero laser light in images that are calculated from others."""
    if given.header is None and bits < 15:
        return 2**bits
    reason = f"{bits} bits leave no room for its sign: give the bits that the camera used, or leave both out"
    if given.header is not None:
        reason = "the header is that of a finished capture: leave out one of the two"
    raise DescriptionError(f"a background or another channel is to be subtracted, but {reason}")


class _Reader:
    """Reader of grey images that must have the size and depth of the first; keeps the last background."""

    def __init__(self, given: ImportDescription, sensor: Sensor, folder: Path):
        self._given, self._sensor, self._folder = given, sensor, folder
        self.dtype: np.dtype = np.dtype(np.void)  # until the first image is read
        self.saturation_dn = given.saturation_dn  # 2^bits - 1 if None
        self.derives = False  # whether the laser's channel is calculated from several
        self._kept: tuple[str, np.ndarray] | None = None

    def image(self, name: str, *, laser_on: bool) -> tuple[np.ndarray, np.ndarray, int]:
        """Read a grey image (H, W), signed for a formula, where it is clipped (H, W), and its bits.

        Raises ImageError if sizes or depths differ.
        """
        given = self._given
        raw = read_image(self._folder / name, accept=partial(self._require_size, name))
        if self.dtype not in (np.void, raw.dtype):
            raise ImageError(f"{name} contains {raw.dtype}, the images before it contain {self.dtype}")
        channel = given.channel if laser_on else given.channel_of_lamp(raw)
        # A header does not state the bits, and the grey values of an exported capture fit in it.
        bits = 8 * raw.itemsize if given.header is not None else bits_of(raw, given.bits, name=name)
        self.dtype = raw.dtype
        values = grey_values(raw, bits=bits, aligned=given.aligned, name=name)
        clipped = values >= (self.saturation_dn or 2**bits - 1)
        if given.bayer is not None:
            values = demosaic(values, given.bayer, name=name)
            clipped = demosaic(255 * clipped.astype(np.uint8), given.bayer, name=name) > 0
        self.derives = is_formula(given.channel, values)
        return extract_channel(values, channel, name=name), combine_clipped(clipped, channel), bits

    def _require_size(self, name: str, declared: ImageHeader) -> None:
        camera, size = self._sensor.camera, (declared.width_px, declared.height_px)
        wanted = camera.width_px, camera.height_px
        if size != wanted:
            before = "" if self.dtype == np.void else " and the images before it"
            raise ImageError(
                f"{name} has {size[0]} x {size[1]} pixels; expected {wanted[0]} x {wanted[1]} as the sensor "
                f"'{self._sensor.name}' has{before}: {_SIZE_ADVICE[self.dtype == np.void, size == wanted[::-1]]}"
            )

    def background(self, name: str) -> np.ndarray:
        """Read the grey image (H, W) without laser, in the laser's channel."""
        if self._kept is None or self._kept[0] != name:
            self._kept = name, self.image(name, laser_on=True)[0]
        return self._kept[1]


def _list_remarks(given: ImportDescription, frames: list[ImageRow], folder: str, *, bits: int, zero_dn: int) -> Table:
    """Return the provenance of the capture."""
    remarks: Table = {"source": "imported images", "uwlts": __version__, "folder": folder}
    remarks |= {"bits": bits, "stage": stage_remark(given)}
    remarks |= {
        key: getattr(given, key) for key in ("bayer", "channel", "lamp_channel", "intrinsics") if getattr(given, key)
    }
    name = frames[0].file.lower()
    if bits == 8 and (given.channel or name.endswith((".jpg", ".jpeg"))):
        remarks["response"] = "not known: 8-bit photographs are usually not proportional to light"
    if zero_dn:
        background = any(row.background is not None for row in frames)
        name, done = ("background", "subtracted from the laser images, ") if background else ("laser_images", "")
        remarks[name] = f"{done}{zero_dn} added"
    if not _is_in_order(frames):
        remarks["time"] = "not known of all images in their order, stored as 0"
    for name, values in (("exposure", [row.exposure_ms for row in frames]), ("time", [row.time_s for row in frames])):
        if any(map(math.isnan, values)) and name not in remarks:
            remarks[name] = "not known of all images, stored as 0 where it is missing"
    return remarks
