"""Where and how the grey levels across the edge of a blob are read."""

import numpy as np

PROFILES = 48

# Inside a small blob half the minor semi-axis is all there is before the opposite edge is felt.
REACH_OVER_MINOR_AXIS = 0.5


def rim_directions():
    """Unit vectors (PROFILES, 2) that an ellipse's shape matrix maps to points of its rim."""
    angle = np.arange(PROFILES) * (2 * np.pi / PROFILES)
    return np.stack([np.cos(angle), np.sin(angle)], 1)


def sample(grey, points):
    """Bilinear grey values (...) at pixel positions (..., 2), which must lie inside the image."""
    width = grey.shape[1]
    whole = points.astype(np.int32)
    part = (points - whole).astype(np.float32)
    index = whole[..., 1] * width + whole[..., 0]
    flat = grey.reshape(-1)
    du, dv = part[..., 0], part[..., 1]
    top = flat[index] * (1 - du) + flat[index + 1] * du
    bottom = flat[index + width] * (1 - du) + flat[index + width + 1] * du
    return top * (1 - dv) + bottom * dv
