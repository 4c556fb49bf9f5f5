"""The stripes of all laser images of a recording."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from uwlts.errors import CaptureError
from uwlts.sensor import Sensor
from uwlts.stripe.absence import why_no_stripe
from uwlts.stripe.extract import extract_stripe
from uwlts.stripe.result import StripeOptions, StripeStatus


class _Header(Protocol):
    @property
    def sensor(self) -> Sensor: ...

    @property
    def saturation_dn(self) -> int: ...


class LaserImages(Protocol):
    """A sequence of images, numbered, of which those taken with the laser on can be read; a capture is one."""

    @property
    def path(self) -> Path: ...

    @property
    def header(self) -> _Header: ...

    def frames(self, *, laser_on: bool | None = None) -> Iterator[tuple[int, np.ndarray]]: ...

    def __len__(self) -> int: ...


@dataclass(frozen=True, eq=False)
class FoundStripes:
    """Stripe centres of all laser images of a recording, joined: N of them.

    Attributes
    ----------
    frame, line : (N,) int
        Image and profile line of each centre.
    centre_px, amplitude, width_px : (N,)
        Place on the line, height in grey levels and full width at half maximum.
    lines_by_status : dict
        What became of the profile lines of all images.
    """

    frame: np.ndarray
    line: np.ndarray
    centre_px: np.ndarray
    amplitude: np.ndarray
    width_px: np.ndarray
    lines_by_status: dict[str, int]

    def __getitem__(self, some: np.ndarray) -> "FoundStripes":
        """Those that an index array or mask chooses."""
        chosen = (self.frame[some], self.line[some], self.centre_px[some], self.amplitude[some], self.width_px[some])
        return FoundStripes(*chosen, self.lines_by_status)


def find_stripes(
    capture: LaserImages,
    *,
    options: StripeOptions = StripeOptions(),
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> FoundStripes:
    """Find the stripe in all laser images of a recording.

    Parameters
    ----------
    capture : LaserImages
        Such as an opened `uwlts.capture.Capture`.
    options : StripeOptions, optional
    progress : callable, optional
        Called after each image with the number of images done and the number in all.

    Raises
    ------
    CaptureError
        The capture holds no laser image, or none of them shows a stripe.
    """
    header = capture.header
    frames, lines, centres, amplitudes, widths = [], [], [], [], []
    statuses = np.zeros(len(StripeStatus), int)
    for number, image in capture.frames(laser_on=True):
        stripe = extract_stripe(
            image, stripe_along=header.sensor.camera.stripe_along, options=options, saturation=header.saturation_dn
        )
        statuses += np.bincount(stripe.status, minlength=len(StripeStatus))
        good = stripe.lines
        centres.append(stripe.centre_px[good])
        lines.append(good)
        frames.append(np.full(len(good), number))
        amplitudes.append(stripe.amplitude[good])
        widths.append(stripe.width_px[good])
        progress(number + 1, len(capture))
    if not centres:
        raise CaptureError(
            f"{capture.path.name} holds no image with the laser on among {len(capture)}: nothing to reconstruct"
        )
    by_status = {status.name.lower(): int(statuses[status]) for status in StripeStatus}
    if statuses[StripeStatus.OK] == 0:
        lit = (image for _, image in capture.frames(laser_on=True))
        reason = why_no_stripe(lit, stripe_along=header.sensor.camera.stripe_along, full_dn=header.saturation_dn)
        raise CaptureError(f"no stripe in any of the {len(centres)} laser images of {capture.path.name}: {reason}")
    return FoundStripes(*(np.concatenate(parts) for parts in (frames, lines, centres, amplitudes, widths)), by_status)
