"""Replay of a folder of images or of a capture as a camera, at its own frame rate or triggered."""

import math
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from uwlts.errors import HardwareError, ImageError
from uwlts.files.reading import is_regular_file, natural_key
from uwlts.hardware.camera_interface import BUFFERS, CameraDevice, CameraInfo, CameraSettings, Delivered
from uwlts.model.stripe import Coordinates, Stripe
from uwlts.storage.capture import Capture
from uwlts.storage.image_file import SUFFIXES, read_image


class ReplayCamera(CameraDevice):
    """Images of a folder in natural order of their names, or of a capture.

    A free-running replay without a frame rate delivers an image on every request. With a frame rate it does not wait
    for a slow program: frames that exceed its buffers are dropped, as by a real camera. Exposures are those of the
    capture; for a folder, the configured one. With ``repeat`` it restarts after the last image; otherwise a further
    ``grab`` raises HardwareError.
    """

    def __init__(self, path: str | Path, *, repeat: bool = False, address: str | None = None):
        super().__init__(address or f"replay:{path}")
        self._path = Path(path)
        self._repeat = repeat
        self._files: list[Path] = []
        self._capture: Capture | None = None
        self._shown = self._due = 0
        self._began_s = 0.0
        self._triggered = False

    def _open(self) -> CameraInfo:
        self._shown = 0
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
            if not self._capture.has_image.all():
                return CameraInfo(
                    f"replay of {self._path.name}", self._path.name, width, height, bits, coordinates=Coordinates()
                )
        else:
            raise HardwareError(f"{self._path} is neither a folder of images nor a capture")
        return CameraInfo(f"replay of {self._path.name}", self._path.name, width, height, bits)

    def _close(self) -> None:
        capture, self._capture, self._files = self._capture, None, []
        if capture is not None:
            capture.close()

    def _configure(self, wanted: CameraSettings) -> CameraSettings:
        if wanted.trigger == "line":
            raise HardwareError(f"{self.address} has no trigger input: use trigger 'free' or 'software'")
        if wanted.bits != self.info.bits:
            raise HardwareError(f"{self.address} has images of {self.info.bits} bits, not {wanted.bits}")
        if wanted.gain_db is not None:
            raise HardwareError(f"{self.address} has no gain setting: leave gain_db out")
        return wanted if self._capture is None else replace(wanted, exposure_ms=float(self._capture.exposure_ms[0]))

    def _start(self) -> None:
        self._began_s, self._due, self._triggered = time.monotonic(), 0, False

    def _stop(self) -> None:
        self._triggered = False

    def _trigger(self) -> None:
        self._triggered = True

    def _next(self, timeout_s: float) -> Delivered | None:
        stamp_s = time.monotonic()
        if self.settings.trigger == "software":
            if not self._triggered:
                time.sleep(timeout_s)
                return None
            self._triggered = False
        elif self.settings.frame_rate_hz is not None:
            stamp_s = self._wait_for_frame(timeout_s, 1 / self.settings.frame_rate_hz)
            if stamp_s is None:
                return None
        self._shown += 1
        return self._deliver(self._shown - 1, stamp_s)

    def _wait_for_frame(self, timeout_s: float, period_s: float) -> float | None:
        """Return the time of the next frame when it is due, or None if it is not due within ``timeout_s``."""
        now_s = time.monotonic()
        lost = int((now_s - self._began_s) / period_s) - self._due - BUFFERS
        if lost > 0:
            self._due, self._shown = self._due + lost, self._shown + lost
        stamp_s = self._began_s + self._due * period_s
        if stamp_s - now_s > timeout_s:
            time.sleep(timeout_s)
            return None
        time.sleep(max(stamp_s - now_s, 0.0))
        self._due += 1
        return stamp_s

    def _deliver(self, index: int, stamp_s: float) -> Delivered:
        capture, info, region = self._capture, self.info, self.settings.region
        count = len(self._files) if capture is None else len(capture)
        if index >= count and not self._repeat:
            raise HardwareError(f"all {count} images of {self._path} have been shown")
        shown = index % count
        seen = _read_image(self._files[shown]) if capture is None else capture.read_observation(shown)
        exposure_ms = None if capture is None else float(capture.exposure_ms[shown])
        if isinstance(image := seen, Stripe):
            known = math.nan if capture is None else float(capture.encoder[shown])
            return Delivered(seen, index + 1, stamp_s, exposure_ms, int(known) if math.isfinite(known) else None)
        if image.shape != (info.height_px, info.width_px) or image.dtype.itemsize != (1 if info.bits == 8 else 2):
            raise ImageError(
                f"image {shown} of {self._path} has {image.shape[1]} x {image.shape[0]} px of {image.dtype}, "
                f"the first one {info.width_px} x {info.height_px} px of {info.bits} bits: give one camera's images"
            )
        part = image[region.y_px : region.y_px + region.height_px, region.x_px : region.x_px + region.width_px]
        return Delivered(np.ascontiguousarray(part), index + 1, stamp_s, exposure_ms)

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
