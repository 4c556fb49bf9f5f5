"""Counts of an encoder whose counter starts again at the end of its range."""

import numpy as np

from uwlts.errors import DescriptionError

_WIDTHS = (16, 24, 32)
"""Bits of usual counters."""
_PLAIN = 3.0
"""Largest ratio of the step at an overflow to the largest other step, for a stage that accelerates meanwhile."""


def unwrap_counts(counts: np.ndarray, bits: int | None = None) -> np.ndarray:
    """Return counts (N,) that continue where the counter passes the end of its range.

    Counts are in the order of time. The width ``bits`` is by default that for which the steps at overflows are like the
    others.

    Raises DescriptionError if the counts exceed the counter, or a jump may be an overflow of a counter of unknown
    width.
    """
    counts = np.asarray(counts, np.float64)
    steps, extent = np.diff(counts), np.ptp(counts) if len(counts) else 0.0
    if bits is not None and extent >= 2.0**bits:
        raise DescriptionError(f"the encoder counts over {extent:.0f}, more than its {bits} bits (encoder_bits)")
    for width in _WIDTHS if bits is None else (bits,):
        span = 2.0**width
        over = np.abs(steps) > span / 2
        if extent >= span or not over.any():
            continue
        continued = np.unwrap(counts, period=span)
        others = np.abs(steps[~over]).max(initial=0)
        if bits is None and not np.abs(np.diff(continued)[over]).max() <= _PLAIN * others:
            place = int(np.argmax(over))
            raise DescriptionError(
                f"the encoder jumps from {counts[place]:.0f} to {counts[place + 1]:.0f}: give the width of its counter "
                "(encoder_bits), such as 16 or 32"
            )
        return continued
    return counts
