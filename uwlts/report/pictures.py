"""Pictures as PNG files, or inside a page."""

from pathlib import Path

import cv2
import numpy as np

from uwlts.capture import Capture
from uwlts.files import written_aside
from uwlts.report.cloud_picture import cloud_picture
from uwlts.report.gather import Campaign, Measurement
from uwlts.report.stripe_picture import stripe_picture, stripe_view


def stripe_png(measurement: Measurement) -> bytes | None:
    """Stripe image of a measurement; None without a capture, or where no image shows a stripe."""
    if measurement.capture is None:
        return None
    with Capture(measurement.capture.path) as capture:
        view = stripe_view(capture)
    return None if view is None else png(stripe_picture(view))


def cloud_png(measurement: Measurement) -> bytes | None:
    """Picture of a measurement's cloud; None without one."""
    return None if measurement.cloud is None else png(cloud_picture(measurement.cloud))


def write_pictures(folder: str | Path, campaign: Campaign, *, overwrite: bool = False) -> list[Path]:
    """Write ``stripe-NAME.png`` and ``cloud-NAME.png`` of every measurement that has them; returns what was written.

    Raises
    ------
    OutputError
        The folder is missing, or a picture exists and ``overwrite`` is not given.
    CaptureError
        An image of a capture is damaged.
    """
    written = []
    for measurement in campaign.measurements:
        for kind, picture in (("stripe", stripe_png(measurement)), ("cloud", cloud_png(measurement))):
            if picture is not None:
                path = Path(folder) / f"{kind}-{measurement.name}.png"
                with written_aside(path, overwrite=overwrite) as aside:
                    aside.write_bytes(picture)
                written.append(path)
    return written


def png(picture: np.ndarray) -> bytes:
    """A picture (H, W, 3) as the bytes of a PNG file."""
    done, encoded = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    if not done:
        raise RuntimeError("OpenCV cannot encode a PNG")
    return encoded.tobytes()
