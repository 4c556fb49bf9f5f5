"""Charge that a full pixel cannot hold and spills along its column."""

import numpy as np


def spilled(charge: np.ndarray, *, full_well_e: float, share: float) -> np.ndarray:
    """Charge (H, W) in electrons after blooming; the given array itself if no pixel is over its full well.

    Half of what a pixel holds above the full well goes up its column and half goes down. It fills the pixels it meets
    and keeps its direction over those that are full, until it fits or leaves the image. At each step from a full pixel
    to the next, ``share`` of it arrives and the rest is drained; a share of 1 loses none.
    """
    columns = np.flatnonzero((charge > full_well_e).any(axis=0))
    if columns.size == 0:
        return charge
    before = np.take(charge, columns, axis=1).astype(float)
    down_first, up_first = (_swept(image, full_well_e, share) for image in (before, before[::-1]))
    after = charge.copy()
    # Where the charge of two pixels meets, whichever comes first takes the room: the mean of both orders favours none.
    after[:, columns] = (down_first + up_first[::-1]) / 2
    return after


def _swept(charge: np.ndarray, full_well_e: float, share: float) -> np.ndarray:
    """Columns after the spilt charge has run down them, then up."""
    kept = np.minimum(charge, full_well_e)
    spilt_each_way = share / 2 * (charge - kept)
    for rows in (range(len(kept)), reversed(range(len(kept)))):
        arriving = np.zeros_like(kept[0])
        for row in rows:
            held = kept[row] + arriving
            kept[row] = np.minimum(held, full_well_e)
            arriving = share * (held - kept[row]) + spilt_each_way[row]
    return kept
