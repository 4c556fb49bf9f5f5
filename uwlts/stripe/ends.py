"""Ends of a stripe: lines beside a place where it ends or jumps, where the sheet meets the surface in part."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from uwlts.model.stripe import Stripe, StripeStatus

_SHORT_GAP = 2
"""A stripe that is lost for so few lines, as in noise, goes on."""

_NONE = np.empty(0, np.intp)

# NumPy compares with its own integers several times as fast as with an enumeration.
_OK, _END = np.uint8(StripeStatus.OK), np.uint8(StripeStatus.END)


def copied(stripe: Stripe) -> Stripe:
    """A stripe of its own arrays."""
    return replace(
        stripe,
        centre_px=stripe.centre_px.copy(),
        amplitude=stripe.amplitude.copy(),
        width_px=stripe.width_px.copy(),
        status=stripe.status.copy(),
    )


def leave_ends_out(stripe: Stripe, *, lines: int, jump_px: float) -> Stripe:
    """A stripe without the last ``lines`` before it ends or jumps, END from now on; see `StripeOptions.end_lines`.

    The stripe itself is changed.
    """
    if lines:
        ends = _half_lit(stripe.status == _OK, stripe.centre_px, lines=lines, jump_px=jump_px)
        stripe.status[ends] = _END
        for values in (stripe.centre_px, stripe.amplitude, stripe.width_px):
            values[ends] = np.nan
    return stripe


def _half_lit(good: np.ndarray, centre: np.ndarray, *, lines: int, jump_px: float) -> np.ndarray:
    """Numbers (M,) of the lines with a centre that are among the ``lines`` last before a stripe ends or jumps.

    ``good`` (L,) marks the lines with a centre. A stripe ends where more than a few lines in a row have none, and
    jumps where neighbouring centres lie more than ``jump_px`` apart. The image's own border is no end.
    """
    found = np.flatnonzero(good)
    if len(found) == 0:
        return found
    place = centre[found]
    # Breaks stand before these of the lines found, and after all of them.
    apart = np.abs(place[1:] - place[:-1]) > jump_px
    if len(found) < len(good):
        apart |= found[1:] - found[:-1] > _SHORT_GAP + 1
    breaks = (1 + np.flatnonzero(apart)).tolist()
    if found[0] > _SHORT_GAP:
        breaks.append(0)
    if len(good) - 1 - found[-1] > _SHORT_GAP:
        breaks.append(len(found))
    if not breaks:
        return _NONE
    beside = np.zeros(len(found) + 2 * lines, np.bool_)
    for each in breaks:
        beside[each : each + 2 * lines] = True
    return found[beside[lines : lines + len(found)]]
