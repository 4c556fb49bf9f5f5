"""Common parts of chessboard and ChArUco detection: 8-bit images, and the quality of corners."""

import cv2
import numpy as np

from uwlts.targets.detection.blobs import checked_grey

# Half the side of the window in which a corner is judged.
HALF_WINDOW = 5


def eight_bit(image):
    """The image (H, W) as uint8, scaled to its own maximum if it has 16 bit; raises `ImageError` for other images."""
    if checked_grey(image).dtype == np.uint8:
        return image
    return np.rint(image * (255.0 / max(int(image.max()), 1))).astype(np.uint8)


def corner_quality(image, pixels):
    """Contrast and sharpness (N,), as in `TargetView`, of corners (N, 2), px, of two bright and two dark fields."""
    rim = HALF_WINDOW + 1
    grey = cv2.copyMakeBorder(image.astype(np.float32), rim, rim, rim, rim, cv2.BORDER_REPLICATE)
    slope = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)) / 8
    span = np.arange(-HALF_WINDOW, HALF_WINDOW + 1) + HALF_WINDOW + 1
    centre = np.rint(pixels).astype(int)
    rows, columns = centre[:, 1, None, None] + span[:, None], centre[:, 0, None, None] + span
    # Half the pixels of the window are bright, half dark: their standard deviation is half the contrast.
    contrast = 2 * grey[rows, columns].std((1, 2), dtype=np.float64)
    steepest = slope[rows, columns].max((1, 2)).astype(np.float64)
    return {"contrast": contrast, "sharpness": steepest / np.maximum(contrast, 1e-9)}
