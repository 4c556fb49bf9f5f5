"""Replay of a folder of images or of a capture as a camera, image by image or triggered."""

import math
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from uwlts.errors import HardwareError, ImageError
from uwlts.files.reading import is_regular_file, natural_key
from uwlts.hardware.camera_interface import CameraDevice, CameraInfo, CameraSettings, Delivered
from uwlts.model.stripe import Coordinates, Stripe
from uwlts.storage.capture import Capture
from uwlts.storage.image_file import SUFFIXES, read_image


class ReplayCamera(CameraDevice):
    """Images of a folder in natural order of their names, or of a capture.

    Each trigger, or each request of a free-running replay, delivers the next image at once. Exposures are those of the
    capture; for a folder, the configured one. A ``grab`` after the last image raises HardwareError.
    """

    def __init__(self, path: str | Path, *, address: str | None = None):
        super().__init__(address or f"replay:{path}")
        self._path = Path(path)
        self._files: list[Path] = []
        self._capture: Capture | None = None
        self._shown = 0
        self._triggered = False

    def _open(self) -> CameraInfo:
        self._shown, coordinates = 0, None
        if self._path.is_dir():
            images = (path for path in self._path.iterdir() if path.suffix.lower() in SUFFIXES)
            self._files = sorted(images, key=lambda path: natural_key(path.name))
            if not self._files:
                raise HardwareError(f"the folder {self._path} contains no image ({', '.join(SUFFIXES)})")
            first = _read_image(self._files[0])
            (height, width), bits = first.shape, 8 * first.itemsize
        elif is_regular_file(self._path):
            self._capture = Capture(self._path)
            if len(self._capture) == 0:
                self._close()
                raise HardwareError(f"the capture {self._path} contains no frame")
            sensor = self._capture.header.sensor
            height, width, bits = sensor.camera.height_px, sensor.camera.width_px, sensor.detector.bits
            coordinates = None if self._capture.has_image.all() else Coordinates()
        else:
            raise HardwareError(f"{self._path} is neither a folder of images nor a capture")
        return CameraInfo(f"replay of {self._path.name}", self._path.name, width, height, bits, coordinates)

    def _close(self) -> None:
        capture, self._capture, self._files = self._capture, None, []
        if capture is not None:
            capture.close()

    def _configure(self, wanted: CameraSettings) -> CameraSettings:
        if wanted.bits != self.info.bits:
            raise HardwareError(f"{self.address} has images of {self.info.bits} bits, not {wanted.bits}")
        if wanted.gain_db is not None:
            raise HardwareError(f"{self.address} has no gain setting: leave gain_db out")
        exposure_ms = wanted.exposure_ms if self._capture is None else float(self._capture.exposure_ms[0])
        return replace(wanted, exposure_ms=exposure_ms, frame_rate_hz=None)

    def _start(self) -> None:
        self._triggered = False

    def _stop(self) -> None:
        self._triggered = False

    def _trigger(self) -> None:
        self._triggered = True

    def _next(self, timeout_s: float) -> Delivered | None:
        if self.settings.trigger == "software":
            if not self._triggered:
                time.sleep(timeout_s)
                return None
            self._triggered = False
        self._shown += 1
        return self._deliver(self._shown - 1)

    def _deliver(self, shown: int) -> Delivered:
        capture, info, stamp_s = self._capture, self.info, time.monotonic()
        count = len(self._files) if capture is None else len(capture)
        if shown >= count:
            raise HardwareError(f"all {count} images of {self._path} have been shown")
        seen = _read_image(self._files[shown]) if capture is None else capture.read_observation(shown)
        exposure_ms = None if capture is None else float(capture.exposure_ms[shown])
        if isinstance(image := seen, Stripe):
            known = math.nan if capture is None else float(capture.encoder[shown])
            return Delivered(seen, shown + 1, stamp_s, exposure_ms, int(known) if math.isfinite(known) else None)
        if image.shape != (info.height_px, info.width_px) or image.dtype.itemsize != (1 if info.bits == 8 else 2):
            raise ImageError(
                f"image {shown} of {self._path} has {image.shape[1]} x {image.shape[0]} px of {image.dtype}, "
                f"the first one {info.width_px} x {info.height_px} px of {info.bits} bits: give one camera's images"
            )
        return Delivered(image, shown + 1, stamp_s, exposure_ms)

    def _answers(self) -> None:
        """Files need no check: reading a missing one raises an error."""


def _read_image(path: Path) -> np.ndarray:
    """Read a grey image (H, W) of uint8 or uint16; raises ImageError for any other image."""
    image = read_image(path)
    if image.ndim != 2:
        raise ImageError(
            f"{path} is a colour image, expected a grey image of 8 or 16 bit: "
            "`uwlts import` converts colour images to a capture, which can be replayed"
        )
    return image
