"""Common parts of chessboard and ChArUco detection: 8-bit images, and the quality of corners."""

import cv2
import numpy as np

from uwlts.targets.detection.blobs import check_grey

HALF_WINDOW = 5
"""Half side of the window for a corner's quality, px."""


def convert_to_eight_bit(image):
    """Return the image (H, W) as uint8, scaled to its maximum if it has 16 bit; raise `ImageError` for others."""
    if check_grey(image).dtype == np.uint8:
        return image
    return np.rint(image * (255.0 / max(int(image.max()), 1))).astype(np.uint8)


def measure_corners(image, pixels):
    """Measure contrast and sharpness (N,), as in `TargetView`, of corners (N, 2) of two bright and two dark fields."""
    rim = HALF_WINDOW + 1
    grey = cv2.copyMakeBorder(image.astype(np.float32), rim, rim, rim, rim, cv2.BORDER_REPLICATE)
    slope = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)) / 8
    span = np.arange(-HALF_WINDOW, HALF_WINDOW + 1) + HALF_WINDOW + 1
    centre = np.rint(pixels).astype(int)
    rows, columns = centre[:, 1, None, None] + span[:, None], centre[:, 0, None, None] + span
    # Half the pixels of the window are bright, half are dark: their standard deviation is half the contrast.
    contrast = 2 * grey[rows, columns].std((1, 2), dtype=np.float64)
    steepest = slope[rows, columns].max((1, 2)).astype(np.float64)
    return {"contrast": contrast, "sharpness": steepest / np.maximum(contrast, 1e-9)}
