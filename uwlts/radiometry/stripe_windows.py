"""Statistics of the stripe in windows of neighbouring profile lines, and the sets of images that they are of.

A statistic is of width, light, centre, surroundings or noise. A set is a data set, a capture, or image files.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from glob import glob
from pathlib import Path

import numpy as np
from scipy.signal import savgol_filter

from uwlts.errors import CaptureError, ImageError
from uwlts.files.reading import is_regular_file
from uwlts.fitting.least_squares import robust_std
from uwlts.model.library import load_sensor, validate_description
from uwlts.model.sensor import Sensor
from uwlts.model.stripe import Stripe
from uwlts.radiometry.stripe_images import CLIPPED, LONGEST_GAP, SMOOTH_LINES
from uwlts.storage.capture import CAPTURES, Capture
from uwlts.storage.data_set import CARD, load_dataset
from uwlts.storage.image_file import SUFFIXES, read_image
from uwlts.stripe import PeakRule, StripeOptions, StripeSettings, extract_stripe
from uwlts.stripe.exposures import split_clipped

_BITS = (8, 10, 12, 14, 16)
"""Bits of cameras."""
_SMOOTH_PX = 2.0
"""Largest distance of centres on neighbouring lines of a smooth stripe; false ones scatter over the whole line."""
WINDOW_LINES = 64
"""Lines of a window: several grains of a real stripe, and a surface that is smooth in most of it."""
_FEWEST = WINDOW_LINES // 2
"""Least number of stripe centres in a window."""
_STRIPE, _NEAR, _FAR = 1.5, (3.0, 5.0), (6.0, 20.0)
"""Distances from the centre, in full widths at half maximum, of the stripe, its halo and the background."""
_LEAST_LIGHT = 0.2
"""Least smooth light, of its mean: where a parabola falls below it, the stripe ends in the window."""
_LEAST_RISE = 0.5
"""Least rise above the brighter side, of that above the darker one: halfway from a printed edge, 0, to a stripe, 1."""
_CROP_PX = 60  # half the height of the pictures of windows: the stripe and its halo
_PICTURES = 8  # largest number of pictures of an image: a page shows all of them


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
        lit = np.flatnonzero(capture.laser_on).tolist()
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
    lengths = [_smooth_length(channels[channel], along, stripe_of, full) for channel, along, stripe_of in tried]
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


@dataclass(frozen=True)
class WindowStatistic:
    """Statistic of a window: name, unit and definition."""

    name: str
    unit: str
    meaning: str


STATISTICS = (
    WindowStatistic("width", "px", "full width at half maximum, median"),
    WindowStatistic("height", "%", "height above the background, median, of full scale"),
    WindowStatistic("contrast", "", "height, divided by height and twice the background"),
    WindowStatistic("scatter", "%", "standard deviation of the stripe's light along it, about a parabola"),
    WindowStatistic("correlation", "", "correlation of this light on neighbouring lines"),
    WindowStatistic("lowest", "%", "light that 5 % of the lines fall below, of the mean"),
    WindowStatistic("wander", "px", "scatter of the centres about a smooth curve"),
    WindowStatistic("halo", "%", "light 3 to 5 widths beside the stripe above the background, of the height"),
    WindowStatistic("background", "%", "grey value 6 to 20 widths beside the stripe, of full scale"),
    WindowStatistic("structure", "%", "scatter of the background beyond its noise, of full scale"),
    WindowStatistic("noise", "%", "scatter of neighbouring pixels of the background, of full scale"),
    WindowStatistic("gaps", "%", "lines without a stripe centre"),
    WindowStatistic("clipped", "%", "lines with clipped pixels"),
)


@dataclass(frozen=True, eq=False)
class StripeWindows:
    """Statistics of N windows of a set of images.

    Attributes
    ----------
    name : str
        Name of the set.
    values : (N, K)
        Values of `STATISTICS`.
    image : (N,) int
        Number of the window's image.
    pictures : tuple of (2 `_CROP_PX` + 1, `WINDOW_LINES`) float32
        Windows of each image, with the stripe along their width, as fractions of full scale.
    """

    name: str
    values: np.ndarray
    image: np.ndarray
    pictures: tuple[np.ndarray, ...]


def measure_windows(images: ImageSet, *, most_images: int) -> StripeWindows:
    """Measure the stripe in all windows of up to ``most_images`` images.

    A window has `WINDOW_LINES` consecutive lines of a stripe without a jump or a long gap, and stripe centres on half
    of them. Windows on printed edges, or with their background outside the image, are left out.
    """
    values, numbers, pictures = [], [], []
    for number, image in enumerate(images.images(most_images)):
        stripe = extract_stripe(
            image, stripe_along=images.stripe_along, options=images.options, saturation=images.full_dn
        )
        profiles = (image if images.stripe_along == "height" else image.T).astype(np.float32) / images.full_dn
        windows = []
        for lines in _cut_windows(stripe, images.options.jump_px):
            if (found := _measure(profiles[lines], stripe, lines)) is not None:
                values.append(found)
                numbers.append(number)
                windows.append(lines)
        chosen = np.unique(np.linspace(0, max(len(windows) - 1, 0), _PICTURES).astype(int))
        pictures += [_cut_picture(profiles, stripe, windows[k]) for k in chosen.tolist() if windows]
    table = np.array(values).reshape(-1, len(STATISTICS))
    return StripeWindows(images.name, table, np.array(numbers, int), tuple(pictures))


def _cut_windows(stripe: Stripe, jump_px: float) -> Iterator[np.ndarray]:
    """Yield the lines (`WINDOW_LINES`,) of all windows."""
    found = stripe.lines
    gaps = (np.diff(found) > LONGEST_GAP + 1) | (np.abs(np.diff(stripe.centre_px[found])) > jump_px)
    for run in (each for each in np.split(found, np.flatnonzero(gaps) + 1) if len(each)):
        for first in range(int(run[0]), int(run[-1]) + 2 - WINDOW_LINES, WINDOW_LINES):
            yield np.arange(first, first + WINDOW_LINES)


def _measure(profiles: np.ndarray, stripe: Stripe, lines: np.ndarray) -> list[float] | None:
    """Return `STATISTICS` of a window, or None; profiles (`WINDOW_LINES`, P) are fractions of full scale."""
    held = np.flatnonzero(np.isfinite(stripe.centre_px[lines]))
    if len(held) < _FEWEST:
        return None
    profiles, centre = profiles[held], stripe.centre_px[lines[held]]
    width = float(np.median(stripe.width_px[lines[held]]))
    signed = (np.arange(profiles.shape[1]) - centre[:, None]) / width
    dist = np.abs(signed)
    within, near, far = dist <= _STRIPE, (dist > _NEAR[0]) & (dist < _NEAR[1]), (dist > _FAR[0]) & (dist < _FAR[1])
    if not near.any() or np.count_nonzero(far) < far.shape[0]:
        return None
    background, beside = float(np.median(profiles[far])), float(np.median(profiles[near]))
    peak = float(np.median(np.where(within, profiles, 0.0).max(axis=1)))
    height = max(peak - background, 1e-6)
    sides = [np.median(profiles[near & one]) for one in (signed < 0, signed > 0) if (near & one).any()]
    light = np.where(within, profiles - beside, 0.0).sum(axis=1)
    smooth = np.polynomial.Polynomial.fit(held, light, 2)(held)
    mean = float(light.mean())
    if mean <= 0 or peak - max(sides) < _LEAST_RISE * (peak - min(sides)):
        return None
    deviation = light / np.maximum(smooth, _LEAST_LIGHT * mean) - 1.0
    next_to = np.flatnonzero(np.diff(held) == 1)
    variance = float(np.mean(deviation**2))
    correlation = float(np.mean(deviation[next_to] * deviation[next_to + 1])) / max(variance, 1e-12)
    wander = robust_std(centre - np.asarray(savgol_filter(centre, SMOOTH_LINES, 2)))
    steps = np.diff(profiles, axis=1)[far[:, 1:] & far[:, :-1]]
    # The mean distance of two numbers with a normal distribution is 2 / sqrt(pi) standard deviations.
    noise = float(np.mean(np.abs(steps))) * np.sqrt(np.pi) / 2
    structure = np.sqrt(max(robust_std(profiles[far] - background) ** 2 - noise**2, 0.0))
    return [
        width,
        100 * height,
        height / (height + 2 * background),
        100 * np.sqrt(variance),
        float(np.clip(correlation, -1.0, 1.0)),
        100 * float(np.quantile(light, 0.05)) / mean,
        float(wander),
        100 * (float(np.mean(profiles[near])) - background) / height,
        100 * background,
        100 * float(structure),
        100 * noise,
        100 * (1 - len(held) / WINDOW_LINES),
        100 * float(np.mean(np.where(within, profiles, 0.0).max(axis=1) >= CLIPPED)),
    ]


def _cut_picture(profiles: np.ndarray, stripe: Stripe, lines: np.ndarray) -> np.ndarray:
    """Return a window (2 `_CROP_PX` + 1, `WINDOW_LINES`) about the stripe, which runs along the width."""
    middle = round(float(np.nanmedian(stripe.centre_px[lines])))
    place = middle + np.arange(-_CROP_PX, _CROP_PX + 1)
    inside = (place >= 0) & (place < profiles.shape[1])
    return np.where(inside, profiles[lines][:, np.clip(place, 0, profiles.shape[1] - 1)], 0.0).T.astype(np.float32)
