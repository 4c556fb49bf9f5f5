"""The peak finder inside a 3D camera: centre of gravity above a threshold, one number of 16 bits per profile line."""

from dataclasses import dataclass

import numpy as np

from uwlts.model.sensor import Camera

INVALID = 0
"""Number of a line without a stripe."""
THRESHOLD = 0.06
"""Share of the full scale above which pixels count: above the noise, as such cameras are set up."""
_FEWEST_PX = 2
"""Narrower things are hot pixels."""
_REACH_PX = 64
"""Things that reach farther from their brightest pixel are no stripe."""


@dataclass(frozen=True)
class PeakFinder:
    """Finds places across profile lines in steps of 1 / ``steps`` px.

    The brightest pixel of a line and the pixels about it above the threshold count, with what is above it as weight, as
    in the cameras' firmware (Fisher and Naidu, "A comparison of algorithms for subpixel peak detection", 1996, centre
    of mass). ``full_scale_dn`` is the largest grey value.
    """

    camera: Camera
    full_scale_dn: int
    steps: int

    def scale_px(self) -> float:
        """Pixels of one step, the scale of the numbers."""
        return 1 / self.steps

    def numbers(self, image: np.ndarray) -> np.ndarray:
        """Places (L,), uint16, on the profile lines of an image (H, W), in steps; `INVALID` without a stripe."""
        across = image if self.camera.stripe_along == "width" else image.T
        lines, brightest = np.arange(across.shape[1]), across.argmax(axis=0)
        place = brightest + np.arange(-_REACH_PX, _REACH_PX + 1)[:, None]
        inside = (place >= 0) & (place < len(across))
        seen = across[np.clip(place, 0, len(across) - 1), lines].astype(np.float32)
        above = np.where(inside, np.maximum(seen - np.float32(THRESHOLD * self.full_scale_dn), 0), 0)
        # All pixels between the brightest one and the first dark one on either side.
        run = np.minimum.accumulate(above[_REACH_PX:] > 0, axis=0)
        before = np.minimum.accumulate(above[_REACH_PX::-1] > 0, axis=0)[::-1]
        together = np.concatenate([before[:-1], run])
        weight = np.where(together, above, 0)
        total = weight.sum(axis=0)
        whole = ~together[0] & ~together[-1] & ~(together & ((place == 0) | (place == len(across) - 1))).any(axis=0)
        found = whole & (together.sum(axis=0) >= _FEWEST_PX)
        centre = (place * weight).sum(axis=0) / np.where(found, total, 1)
        return np.where(found, np.rint(centre * self.steps), INVALID).astype(np.uint16)
