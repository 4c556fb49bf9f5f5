"""Images of circles: where they are, how good they are, and which of them carry a mark."""

from dataclasses import replace

import numpy as np

from uwlts.targets.detection.blobs import find_blobs
from uwlts.targets.detection.centroids import area_centroids
from uwlts.targets.detection.ellipses import fit_ellipses, rim_directions, sample


def find_circles(image):
    """Find the images of circles of one polarity and similar size, bright on dark or dark on bright.

    Follows G. S. de Matos (UFSC 2017, section 4.5: median filter, background-corrected threshold, hole filling,
    removal of border and small particles, ellipse fit) up to the blobs; ellipse and centre come from the grey levels.

    Parameters
    ----------
    image : (H, W) uint8 or uint16

    Returns
    -------
    Ellipses
        Centres are centroids of the covered area, in px (u, v); possibly none.

    Raises
    ------
    ImageError
        The image is no grey image of 8 or 16 bit.
    """
    ellipses = fit_ellipses(image, find_blobs(image))
    centres, agree = area_centroids(image.astype(np.float32), ellipses)
    return replace(ellipses, centres=centres)[agree]


def mark_strength(image, circles, *, mark_over_circle):
    """How strongly each circle shows a centred dot of the opposite brightness.

    Parameters
    ----------
    image : (H, W) uint8 or uint16
    circles : Ellipses
        Of that image.
    mark_over_circle : float
        Diameter of the dot over the diameter of the circle, between 0 and 1.

    Returns
    -------
    (N,) float64
        (ring - dot) / contrast: about 0 without a dot, towards 1 with a sharp one.
    """
    grey = image.astype(np.float32)
    rim = rim_directions() @ circles.shapes
    dot = np.mean(
        [sample(grey, circles.centres[:, None] + share * mark_over_circle * rim) for share in (0.0, 0.25, 0.5)], (0, 2)
    )
    ring = sample(grey, circles.centres[:, None] + (1 + mark_over_circle) / 2 * rim).mean(1)
    return (ring - dot) / circles.contrast * (1.0 if circles.bright else -1.0)
