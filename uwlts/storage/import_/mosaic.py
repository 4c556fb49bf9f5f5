"""Raw images of colour sensors: recognition of a Bayer mosaic in grey images, and demosaicing."""

from typing import Literal

import cv2
import numpy as np

from uwlts.errors import ImageError

BayerPattern = Literal["RGGB", "GRBG", "GBRG", "BGGR"]
"""Colours of the first two rows and columns of a sensor."""

_CODES = {
    "RGGB": cv2.COLOR_BayerRGGB2BGR,
    "GRBG": cv2.COLOR_BayerGRBG2BGR,
    "GBRG": cv2.COLOR_BayerGBRG2BGR,
    "BGGR": cv2.COLOR_BayerBGGR2BGR,
}
_SMOOTH, _ALTERNATING = np.array([1, 2, 1], np.float32) / 4, np.array([-1, 2, -1], np.float32) / 4
_LIT = 0.3  # least brightness of the evaluated pixels, relative to the brightest
_LEAST_SHARE = 0.1
"""Least alternation of a mosaic relative to the mean signal: 0.8 for laser light, below 0.01 in images of grey cameras
and colour channels."""
_LEAST_SIGNIFICANCE = 6  # alternation over its standard error
_BORDER = 2  # pixels that the interpolation of a mosaic does not fill


def demosaic(image: np.ndarray, pattern: BayerPattern, *, name: str) -> np.ndarray:
    """Return a colour image (H, W, 3) in blue, green, red by bilinear interpolation of a raw image (H, W).

    Raises ImageError for a colour image.
    """
    if image.ndim != 2:
        raise ImageError(f"{name} is a colour image, which has no Bayer pattern: leave bayer out")
    return cv2.demosaicing(image, _CODES[pattern])


def is_mosaic(image: np.ndarray) -> bool:
    """Return whether the bright parts of a grey image (H, W) alternate from pixel to pixel as a Bayer mosaic does.

    A mosaic alternates along rows and columns equally (red against blue), or in a chequerboard (green). Stripes and
    interlaced rows alternate in one direction at most; noise alternates with random sign.
    """
    grey = image.astype(np.float32)
    inner = np.s_[_BORDER:-_BORDER, _BORDER:-_BORDER]
    bright = cv2.sepFilter2D(grey, -1, _SMOOTH, _SMOOTH)[inner]
    if bright.size == 0:
        return False
    dark, most = np.percentile(bright, (20, 99.9))
    lit = bright > dark + _LIT * (most - dark)
    if not lit.any():
        return False
    signal = float(bright[lit].mean() - dark)
    sign_y, sign_x = (1 - 2 * (np.arange(size, dtype=np.float32) % 2) for size in grey.shape)

    def alternation(along_x: np.ndarray, along_y: np.ndarray, sign: np.ndarray) -> float:
        """Return the mean alternation relative to the signal; 0 if it is not significant."""
        values = (cv2.sepFilter2D(grey, -1, along_x, along_y) * sign)[inner][lit]
        # Neighbouring values of the filters are correlated over about 16 pixels.
        error = 4 * float(values.std()) / np.sqrt(values.size)
        mean = abs(float(values.mean()))
        return mean / signal if mean > _LEAST_SIGNIFICANCE * error else 0.0

    in_rows = alternation(_ALTERNATING, _SMOOTH, sign_x[None, :])
    in_columns = alternation(_SMOOTH, _ALTERNATING, sign_y[:, None])
    chequered = alternation(_ALTERNATING, _ALTERNATING, sign_y[:, None] * sign_x[None, :])
    return max(chequered, min(in_rows, in_columns)) > _LEAST_SHARE
