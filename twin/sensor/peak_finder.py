"""Peak finder of a 3D camera: centre of gravity above a threshold, one 16-bit number per profile line."""

from dataclasses import dataclass

import numpy as np

from uwlts.model.sensor import Camera

INVALID = 0
"""Number of a line without a stripe."""
THRESHOLD = 0.06
"""Fraction of the full scale above which pixels count: above the noise, as usual for such cameras."""
_FEWEST_PX = 2
"""Smallest width of a stripe; narrower peaks are hot pixels."""
_REACH_PX = 64
"""Largest distance of a stripe's edge from its brightest pixel."""


@dataclass(frozen=True)
class PeakFinder:
    """Finder of peak positions across profile lines in steps of 1 / ``steps`` px.

    It uses the brightest pixel of a line and the contiguous pixels above the threshold, weighted by their excess, as
    the firmware of cameras does (Fisher and Naidu, "A comparison of algorithms for subpixel peak detection", 1996,
    centre of mass). ``full_scale_dn`` is the largest grey value.
    """

    camera: Camera
    full_scale_dn: int
    steps: int

    def scale_px(self) -> float:
        """Return the size of one step in pixels."""
        return 1 / self.steps

    def numbers(self, image: np.ndarray) -> np.ndarray:
        """Return positions (L,), uint16, in steps on the profile lines of an image (H, W).

        Lines without a stripe get `INVALID`.
        """
        across = image if self.camera.stripe_along == "width" else image.T
        lines, brightest = np.arange(across.shape[1]), across.argmax(axis=0)
        place = brightest + np.arange(-_REACH_PX, _REACH_PX + 1)[:, None]
        inside = (place >= 0) & (place < len(across))
        seen = across[np.clip(place, 0, len(across) - 1), lines].astype(np.float32)
        above = np.where(inside, np.maximum(seen - np.float32(THRESHOLD * self.full_scale_dn), 0), 0)
        # Pixels from the brightest one to the first dark one on either side.
        run = np.minimum.accumulate(above[_REACH_PX:] > 0, axis=0)
        before = np.minimum.accumulate(above[_REACH_PX::-1] > 0, axis=0)[::-1]
        together = np.concatenate([before[:-1], run])
        weight = np.where(together, above, 0)
        total = weight.sum(axis=0)
        whole = ~together[0] & ~together[-1] & ~(together & ((place == 0) | (place == len(across) - 1))).any(axis=0)
        found = whole & (together.sum(axis=0) >= _FEWEST_PX)
        centre = (place * weight).sum(axis=0) / np.where(found, total, 1)
        return np.where(found, np.rint(centre * self.steps), INVALID).astype(np.uint16)
