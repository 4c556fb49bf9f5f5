"""Stripe centres of an image and of a capture."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np


class StripeStatus(IntEnum):
    """Result of stripe detection on a profile line; only OK has a centre."""

    OK = 0
    NO_STRIPE = 1
    """No peak on the line is above the threshold and has the width of a stripe."""
    AMBIGUOUS = 2
    """A second stripe of comparable strength; see `uwlts.stripe.StripeOptions.ambiguous_ratio`."""
    BORDER = 3
    """The window around the centre extends beyond the image border."""
    SATURATED = 4
    """The saturated plateau is too wide for the window; moderate saturation is OK."""
    END = 5
    """Close to an end or jump of the stripe; see `uwlts.stripe.StripeOptions.end_lines`."""


_OK = np.uint8(StripeStatus.OK)  # NumPy compares with its own integers several times faster than with an enumeration


@dataclass(frozen=True)
class Stripe:
    """Stripe centres of one image with L profile lines.

    Attributes
    ----------
    centre_px : (L,) float64
        Position along the line, px; 0 is the centre of pixel 0. NaN if the status is not OK.
    amplitude : (L,) float32
        Height in grey values above the local background of the best-fitting Gaussian with the measured width. Too low
        if the image is saturated. NaN if the status is not OK.
    width_px : (L,) float32
        Full width at half maximum, px, corrected for the smoothing across the stripe. NaN if the status is not OK.
    status : (L,) uint8
        `StripeStatus` of each line.
    stripe_along : str
        ``"height"``: lines are image rows. ``"width"``: lines are image columns.
    """

    centre_px: np.ndarray
    amplitude: np.ndarray
    width_px: np.ndarray
    status: np.ndarray
    stripe_along: str

    @property
    def lines(self) -> np.ndarray:
        """Indices (M,) of the lines with a centre."""
        return np.flatnonzero(self.status == _OK)

    @classmethod
    def from_lines(
        cls,
        lines: np.ndarray,
        centre_px: np.ndarray,
        amplitude: np.ndarray,
        width_px: np.ndarray,
        *,
        status: np.ndarray,
        stripe_along: str,
    ) -> Stripe:
        """Make a stripe from values (M,) of centres on ``lines`` (M,), and the status (L,) uint8 of all lines."""
        centre = np.full(len(status), np.nan)
        height, width = np.full((2, len(status)), np.nan, np.float32)
        centre[lines], height[lines], width[lines] = centre_px, amplitude, width_px
        return cls(centre, height, width, status, stripe_along)

    def remove_lines(self, lines: np.ndarray, reason: StripeStatus) -> Stripe:
        """Return the stripe without the centres on lines (M,), whose status becomes ``reason``."""
        columns = self.centre_px, self.amplitude, self.width_px, self.status
        centre, amplitude, width, status = (column.copy() for column in columns)
        centre[lines], amplitude[lines], width[lines], status[lines] = np.nan, np.nan, np.nan, reason
        return Stripe(centre, amplitude, width, status, self.stripe_along)

    def pixels(self) -> np.ndarray:
        """Return the image coordinates (M, 2), u = column and v = row in px, of the centres of `lines`."""
        return stack_pixels(self.lines, self.centre_px[self.lines], stripe_along=self.stripe_along)


@dataclass(frozen=True)
class StripeCandidates:
    """All M stripe candidates of one image, sorted by line and centre: several sheets, or reflections."""

    line: np.ndarray  # (M,) int; profile line of each candidate; a line can have any number of candidates
    # (M,), float32, float32; as in `Stripe`.
    centre_px: np.ndarray
    amplitude: np.ndarray
    width_px: np.ndarray
    log_likelihood: np.ndarray
    """(M,); log likelihood ratio of the pixels with and without the stripe, for white noise of the background."""
    count: int  # number L of profile lines
    stripe_along: str  # as in `Stripe`

    def __getitem__(self, some: np.ndarray) -> StripeCandidates:
        """Return the candidates selected by an index array or a mask."""
        columns = self.line, self.centre_px, self.amplitude, self.width_px, self.log_likelihood
        kept = (column[some] for column in columns)
        return StripeCandidates(*kept, count=self.count, stripe_along=self.stripe_along)

    def pixels(self) -> np.ndarray:
        """Return the image coordinates (M, 2), u = column and v = row in px."""
        return stack_pixels(self.line, self.centre_px, stripe_along=self.stripe_along)


@dataclass(frozen=True, eq=False)
class CaptureStripes:
    """All N stripe centres of a capture's laser images."""

    # (N,) int; image and profile line of each centre.
    frame: np.ndarray
    line: np.ndarray
    # (N,), float32, float32; as in `Stripe`.
    centre_px: np.ndarray
    amplitude: np.ndarray
    width_px: np.ndarray
    lines_by_status: dict[str, int]  # number of profile lines in all images for each name of `StripeStatus`

    def __getitem__(self, some: np.ndarray | slice) -> CaptureStripes:
        """Return the centres selected by a slice, an index array or a mask."""
        columns = self.frame, self.line, self.centre_px, self.amplitude, self.width_px
        return CaptureStripes(*(column[some] for column in columns), lines_by_status=self.lines_by_status)


def stack_pixels(lines: np.ndarray, places_px: np.ndarray, *, stripe_along: str) -> np.ndarray:
    """Return image coordinates (N, 2), u = column and v = row in px, of centres (N,) on profile lines (N,)."""
    order = (places_px, lines) if stripe_along == "height" else (lines, places_px)
    return np.column_stack(order).astype(np.float64)
