"""Sets of laser images for statistics: data sets, captures, folders of image files, and single image files."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from glob import glob
from pathlib import Path

import numpy as np

from uwlts.errors import CaptureError, ImageError
from uwlts.files.reading import is_regular_file
from uwlts.model.library import load_sensor, validate_description
from uwlts.model.sensor import Sensor
from uwlts.storage.capture import CAPTURES, Capture
from uwlts.storage.data_set import CARD, load_dataset
from uwlts.storage.image_file import SUFFIXES, read_image
from uwlts.stripe import PeakRule, StripeOptions, StripeSettings, extract_stripe
from uwlts.stripe.exposures import split_clipped

_BITS = (8, 10, 12, 14, 16)
"""Bits of cameras."""
_SMOOTH_PX = 2.0
"""Largest distance of centres on neighbouring lines of a smooth stripe; false ones scatter over the whole line."""


@dataclass(frozen=True, eq=False)
class ImageSet:
    """Laser images with one direction of the stripe."""

    name: str  # name of the file or folder
    stripe_along: str  # ``"height"`` or ``"width"``, as for `extract_stripe`
    full_dn: float  # grey value of clipped pixels
    options: StripeOptions  # options for finding the stripe
    count: int  # number of images
    read: Callable[[Sequence[int]], Iterator[np.ndarray | None]]
    """Yields images (H, W), uint8 or uint16, by their numbers, without marks of clipped pixels; None for an image
    without the laser."""

    def images(self, most: int) -> Iterator[np.ndarray]:
        """Return up to a number of laser images (H, W), evenly chosen."""
        numbers = np.unique(np.linspace(0, self.count - 1, min(most, self.count)).astype(int)).tolist()
        return (image for image in self.read(numbers) if image is not None)


def open_image_set(source: str | Path, *, stripe: StripeSettings = None) -> ImageSet:
    """Open images for statistics.

    ``source`` is a data set's folder, a capture, a folder with image files, an image file, or a pattern such as
    ``"bust/laser_*.png"``. Direction of the stripe and options are those of a data set's or capture's sensor. For image
    files, the direction, and the channel of coloured images, are those that show the longest smooth stripe in the first
    image. The first of several stripes is measured if it is longer than the unambiguous one.
    Full scale of 16-bit image files is 2^n - 1 for the smallest n of 10, 12, 14, 16 that the first image allows.

    Raises CaptureError or ImageError if a file cannot be read, there are no images, or the first image file shows no
    stripe; DescriptionError if a setting of the stripe is unknown or out of range.
    """
    path = Path(source)
    if (path / CARD).is_file():
        return _open_data_set(path, stripe)
    return _open_capture(path, stripe) if path.suffix.lower() in CAPTURES else _open_files(path, stripe)


def _open_data_set(folder: Path, stripe: StripeSettings) -> ImageSet:
    samples = load_dataset(folder, names=("image", "info"))
    sensor = validate_description(Sensor, samples.card.description.get("sensor"), folder / CARD)
    if "bits" not in samples.card.image:
        raise CaptureError(f"{folder / CARD} is damaged: it does not state the number of bits of the images")

    def read(numbers: Sequence[int]) -> Iterator[np.ndarray | None]:
        for sample in map(samples.__getitem__, numbers):
            yield sample["image"] if sample["info"].get("light") != "lamp" else None

    full = 2.0 ** samples.card.image["bits"] - 1
    options = StripeOptions.resolve(sensor, stripe)
    return ImageSet(folder.name, sensor.camera.stripe_along, full, options, len(samples), read)


def _open_capture(path: Path, stripe: StripeSettings) -> ImageSet:
    with Capture(path) as capture:
        header = capture.header
        lit = np.flatnonzero(capture.laser_on & capture.has_image).tolist()
    if not lit:
        raise CaptureError(f"{path} has no laser image; statistics of the stripe need images")

    def read(numbers: Sequence[int]) -> Iterator[np.ndarray]:
        with Capture(path) as again:
            for number in numbers:
                yield split_clipped(again.image(lit[number]), header.saturation_dn)[0]

    options = StripeOptions.resolve(header.sensor, stripe)
    return ImageSet(path.name, header.sensor.camera.stripe_along, header.saturation_dn, options, len(lit), read)


def _open_files(path: Path, stripe: StripeSettings) -> ImageSet:
    if path.is_dir():
        files = [each for each in sorted(path.iterdir()) if each.suffix.lower() in SUFFIXES]
    else:
        files = [path] if is_regular_file(path) else sorted(map(Path, glob(str(path))))
    if not files:
        raise ImageError(
            f"{path} has no images: give a data set, a capture (.h5), a folder, a file or a quoted pattern of images "
            f"({', '.join(SUFFIXES)})"
        )
    options = StripeOptions.resolve(load_sensor("thesis"), stripe)
    first = read_image(files[0])
    bits = next(bits for bits in _BITS if first.max() < 2**bits and (bits > 8) == (first.dtype == np.uint16))
    full = 2.0**bits - 1
    channels = [first] if first.ndim == 2 else [np.ascontiguousarray(first[:, :, k]) for k in range(first.shape[2])]
    rules = [options.peak, PeakRule.FIRST] if options.peak is PeakRule.DIRECT else [options.peak]
    tried = [
        (channel, along, replace(options, peak=rule))
        for rule in rules
        for channel in range(len(channels))
        for along in ("height", "width")
    ]
    lengths = [_smooth_length(channels[channel], along, own, full) for channel, along, own in tried]
    if not max(lengths):
        raise ImageError(f"no stripe is found in {files[0]}; expected images with the laser on")
    channel, along, options = tried[int(np.argmax(lengths))]

    def read(numbers: Sequence[int]) -> Iterator[np.ndarray]:
        for file in (files[number] for number in numbers):
            image = read_image(file)
            if image.dtype != first.dtype or image.max() > full:
                raise ImageError(
                    f"{file} is {image.dtype} with grey values up to {image.max()}, {files[0]} is of {bits} bits: "
                    "give images of one camera in a folder"
                )
            yield np.ascontiguousarray(image if image.ndim == 2 else image[:, :, channel])

    name = path.name if path.is_dir() else f"{path.parent.name}/{path.name}"
    return ImageSet(name, along, full, options, len(files), read)


def _smooth_length(image: np.ndarray, along: str, options: StripeOptions, full: float) -> int:
    """Return the number of neighbouring lines with nearly equal centres; 0 if the lines are too short for a stripe."""
    try:
        stripe = extract_stripe(image, stripe_along=along, options=options, saturation=full)
    except ImageError:
        return 0
    return int(np.count_nonzero(np.abs(np.diff(stripe.centre_px)) < _SMOOTH_PX))
