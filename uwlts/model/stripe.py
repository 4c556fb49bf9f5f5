"""Stripe centres of an image and of a capture, and how they follow from the numbers of a 3D camera.

A 3D camera finds the stripe itself and gives one number per profile line, in the pixel format Coord3D_C16 or as 16-bit
images, tables or arrays. A place on a line is ``scale`` times the number plus ``offset`` (GenICam Standard Features
Naming Convention 2.7, ``Scan3dCoordinateScale``, ``Scan3dCoordinateOffset``), and one number can stand for no stripe
(``Scan3dInvalidDataValue``, where ``Scan3dInvalidDataFlag`` is set).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from uwlts.errors import ImageError, RangeError


class StripeStatus(IntEnum):
    """Reason why a line has a centre or has none."""

    OK = 0
    NO_STRIPE = 1
    """Nothing on the line rises above the threshold, or only things too narrow or too wide for a stripe."""
    AMBIGUOUS = 2
    """A second stripe of comparable strength; see `uwlts.stripe.StripeOptions.ambiguous_ratio`."""
    BORDER = 3
    """The pixels needed around the centre run over the image border."""
    SATURATED = 4
    """The clipped plateau is too wide for the window; moderate clipping is handled and stays OK."""
    END = 5
    """Next to a place where the stripe ends or jumps; see `uwlts.stripe.StripeOptions.end_lines`."""


_OK = np.uint8(StripeStatus.OK)  # NumPy compares with its own integers several times as fast as with an enumeration


@dataclass(frozen=True)
class Stripe:
    """Stripe centres of one image, or of what a 3D camera gives in its place; L profile lines.

    Attributes
    ----------
    centre_px : (L,) float64
        Position along the line, px; pixel 0's centre is 0. NaN where the status is not OK.
    amplitude : (L,) float32
        Height above the local background, grey levels, of the Gaussian of the measured width that fits best; less
        than the true height where the image is saturated. NaN where the status is not OK.
    width_px : (L,) float32
        Full width at half maximum, px, with the smoothing across the stripe taken out. NaN where not OK.
    status : (L,) uint8
        A `StripeStatus` per line.
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
        """(M,) int: indices of the lines with a centre."""
        return np.flatnonzero(self.status == _OK)

    @classmethod
    def on_lines(
        cls,
        lines: np.ndarray,
        centre_px: np.ndarray,
        amplitude: np.ndarray,
        width_px: np.ndarray,
        *,
        status: np.ndarray,
        stripe_along: str,
    ) -> Stripe:
        """Return the stripe with centres on some lines (M,) alone; ``status`` (L,) is that of all lines."""
        centre = np.full(len(status), np.nan)
        height, width = np.full((2, len(status)), np.nan, np.float32)
        centre[lines], height[lines], width[lines] = centre_px, amplitude, width_px
        return cls(centre, height, width, status, stripe_along)

    def without(self, lines: np.ndarray, reason: StripeStatus) -> Stripe:
        """Return the stripe with no centre on some lines (M,), for the reason that a status names."""
        centre, amplitude, width, status = (getattr(self, row).copy() for row in ROWS)
        centre[lines], amplitude[lines], width[lines], status[lines] = np.nan, np.nan, np.nan, reason
        return Stripe(centre, amplitude, width, status, self.stripe_along)

    def pixels(self) -> np.ndarray:
        """(M, 2) float64: image coordinates (u = column, v = row) of the centres of `lines`, px."""
        return pixels_of(self.lines, self.centre_px[self.lines], stripe_along=self.stripe_along)


@dataclass(frozen=True)
class StripeCandidates:
    """All stripes of one image, M of them, in the order of lines and places: of several sheets, of reflections.

    Attributes
    ----------
    line : (M,) int
        Profile line of each; a line may have none, one, or several.
    centre_px, amplitude, width_px : (M,) float64, float32, float32
        As of `Stripe`.
    log_likelihood : (M,) float64
        Logarithm of the likelihood that the pixels have with the stripe over that without it, for the background's
        white noise.
    count : int
        Number L of profile lines.
    stripe_along : str
        As of `Stripe`.
    """

    line: np.ndarray
    centre_px: np.ndarray
    amplitude: np.ndarray
    width_px: np.ndarray
    log_likelihood: np.ndarray
    count: int
    stripe_along: str

    def __getitem__(self, some: np.ndarray) -> StripeCandidates:
        """Those that an index array or a mask chooses."""
        columns = self.line, self.centre_px, self.amplitude, self.width_px, self.log_likelihood
        kept = (column[some] for column in columns)
        return StripeCandidates(*kept, count=self.count, stripe_along=self.stripe_along)

    def split(self, sheets: int = 2) -> list[Stripe]:
        """Return one `Stripe` for each of so many sheets of light, in the order of growing places.

        Lines with another number of stripes than sheets do not show which is which: they are AMBIGUOUS, those without
        any NO_STRIPE. RangeError for a number of sheets below 1.
        """
        if sheets < 1:
            raise RangeError(f"sheets is {sheets}; expected 1 or more")
        on_line = np.bincount(self.line, minlength=self.count)
        status = np.full(self.count, StripeStatus.AMBIGUOUS, np.uint8)
        status[on_line == 0], status[on_line == sheets] = StripeStatus.NO_STRIPE, StripeStatus.OK
        lines = np.flatnonzero(on_line == sheets)
        found = []
        for number in range(sheets):
            own = self[np.searchsorted(self.line, lines) + number]
            columns = own.centre_px, own.amplitude, own.width_px
            found.append(Stripe.on_lines(lines, *columns, status=status.copy(), stripe_along=self.stripe_along))
        return found

    def pixels(self) -> np.ndarray:
        """(M, 2) float64: image coordinates (u = column, v = row), px."""
        return pixels_of(self.line, self.centre_px, stripe_along=self.stripe_along)


@dataclass(frozen=True, eq=False)
class CaptureStripes:
    """Stripe centres of all laser images of a capture, joined: N of them.

    Attributes
    ----------
    frame, line : (N,) int
        Image and profile line of each centre.
    centre_px, amplitude, width_px : (N,) float64, float32, float32
        As of `Stripe`; amplitude and width are NaN where a 3D camera does not give them.
    lines_by_status : dict
        Numbers of the profile lines of all images by the names of `StripeStatus`.
    """

    frame: np.ndarray
    line: np.ndarray
    centre_px: np.ndarray
    amplitude: np.ndarray
    width_px: np.ndarray
    lines_by_status: dict[str, int]

    def __getitem__(self, some: np.ndarray | slice) -> CaptureStripes:
        """Those that a slice, an index array or a mask chooses."""
        columns = self.frame, self.line, self.centre_px, self.amplitude, self.width_px
        return CaptureStripes(*(column[some] for column in columns), lines_by_status=self.lines_by_status)


def pixels_of(lines: np.ndarray, places_px: np.ndarray, *, stripe_along: str) -> np.ndarray:
    """(N, 2) float64: image coordinates (u = column, v = row) of places (N,) on profile lines (N,), px."""
    order = (places_px, lines) if stripe_along == "height" else (lines, places_px)
    return np.column_stack(order).astype(np.float64)


ROWS = ("centre_px", "amplitude", "width_px", "status")
"""What can be given of every profile line, in this order; the first alone is needed."""


@dataclass(frozen=True)
class Coordinates:
    """Meaning of a 3D camera's numbers: ``scale`` in px, ``offset`` in px, the number for no stripe if there is one."""

    scale: float = 1.0
    offset: float = 0.0
    invalid: float | None = None

    def stripe(self, numbers: np.ndarray, *, stripe_along: str, length_px: int) -> Stripe:
        """The stripe of a profile (L,), or of up to four rows (K, L) in the order of `ROWS`; NaN is no stripe either.

        ``length_px`` is how many pixels a profile line has. Amplitude and width are NaN where they are not given. A
        status of its own is one of `StripeStatus`. ImageError where places lie beyond the lines, or a status is
        unknown.
        """
        rows = np.atleast_2d(np.asarray(numbers, float))
        if rows.ndim != 2 or len(rows) > len(ROWS):
            raise ImageError(f"a centre line has the shape {numbers.shape}; expected (L,), or up to 4 rows of L")
        valid = np.isfinite(rows[0])
        if self.invalid is not None:
            valid &= rows[0] != self.invalid
        status = np.where(valid, StripeStatus.OK, StripeStatus.NO_STRIPE)
        if len(rows) == len(ROWS):
            if not np.isin(rows[3], list(StripeStatus)).all():
                raise ImageError(f"a centre line has statuses other than 0 to {max(StripeStatus):d}: {rows[3]}")
            status = np.where(valid | (rows[3] != StripeStatus.OK), rows[3], StripeStatus.NO_STRIPE)
        good = status == StripeStatus.OK
        centre = np.where(good, self.scale * rows[0] + self.offset, np.nan)
        if good.any() and not -0.5 <= np.nanmin(centre) <= np.nanmax(centre) <= length_px - 0.5:
            raise ImageError(
                f"the centre lines run from {np.nanmin(centre):g} to {np.nanmax(centre):g} px, the profile lines from "
                f"0 to {length_px - 1} px: check scale ({self.scale:g}), offset ({self.offset:g}) and the number for "
                f"no stripe ({self.invalid})"
            )
        amplitude, width = (
            np.where(good, rows[k], np.nan) if len(rows) > k else np.full(len(centre), np.nan) for k in (1, 2)
        )
        return Stripe(
            centre, amplitude.astype(np.float32), width.astype(np.float32), status.astype(np.uint8), stripe_along
        )


def rows_of(stripe: Stripe) -> np.ndarray:
    """Everything known of a stripe's lines as an array (4, L) in the order of `ROWS`."""
    return np.stack([getattr(stripe, row) for row in ROWS]).astype(float)
