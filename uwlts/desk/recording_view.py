"""Display of a recording in progress on the page: its latest image with the stripe, warnings, and the cloud so far."""

import queue
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Self

import numpy as np

from uwlts.desk.shown_state import Board, FrameProfile, Picture
from uwlts.errors import CaptureError
from uwlts.model.calibration import AnyCalibration
from uwlts.storage.capture import Capture, CaptureHeader, Frame, part_path
from uwlts.stripe import extract_stripe, warm_up

LOOK_S = 0.1  # interval between checks for new images; a check takes a few ms
_DAMAGED_S = 5.0
"""Time after which a recording that cannot be read is damaged; an image is written in a fraction of a second."""
_WAITING = 64  # images in the queue for display during a scan; further ones are recorded but not shown
_FAINT, _MANY, _FEW = 0.1, 0.05, 0.05
"""Limits of a laser image: faint below this fraction of full scale; saturated above this fraction of saturated lines;
too little of the stripe below this fraction of lines with a point."""


class RecordingView:
    """Display of the images of recordings on a board; ``calibration`` is for the cloud.

    `show` raises CalibrationError if the calibration does not fit the recording.
    """

    def __init__(self, board: Board, header: CaptureHeader, calibration: AnyCalibration | None, *, name: str = ""):
        self._board, self._header, self._calibration = board, header, calibration
        self._found = self._lines = 0
        self._said: set[str] = set()
        warm_up()
        board.cloud.clear()
        board.cloud_name = name or header.name

    def show(self, frame: Frame, number: int) -> None:
        """Show an image, and add its profile to the cloud."""
        board, full = self._board, self._header.saturation_dn
        light = "laser" if frame.laser_on else "lamp"
        caption = f"image {number + 1}, {light}, stage at {frame.stage_mm:.3f} mm, exposure {frame.exposure_ms:.3g} ms"
        board.position_mm = frame.stage_mm
        if not frame.laser_on:
            board.show(Picture(frame.image, full_dn=full, caption=caption))
            return
        camera = self._header.sensor.camera
        stripe = extract_stripe(frame.image, stripe_along=camera.stripe_along, saturation=full)
        pixels, remarks = stripe.pixels(), []
        self._found, self._lines = self._found + len(pixels), self._lines + len(stripe.status)
        caption += f"; stripe on {self._found:,} of {self._lines:,} profile lines so far"
        brightest = frame.image.max(axis=0 if camera.stripe_along == "width" else 1)
        saturated = float((brightest >= full).mean())
        if saturated > _MANY:
            remarks.append("saturated on many lines: shorten the exposure")
        elif np.quantile(brightest, 0.98) < _FAINT * full:
            remarks.append("faint: lengthen the exposure, or is the laser off?")
        if len(stripe.lines) < _FEW * len(stripe.status):
            remarks.append("almost no stripe: is the object in the volume?")
        board.show(Picture(frame.image, full_dn=full, caption=caption, stripe=pixels, saturated=saturated))
        if self._calibration is not None and len(stripe.lines):
            profile = FrameProfile(frame, stripe, self._header, self._calibration)
            board.cloud.add(profile.points.points_mm, intensity=profile.points.intensity)
            board.profile = profile
        for remark in remarks:
            # Once each, because they stay in the log.
            if remark not in self._said:
                self._said.add(remark)
                board.say(f"image {number + 1}: {remark}", "warning")


def follow_frames(path: Path) -> Iterator[tuple[CaptureHeader, int, Frame] | None]:
    """Iterate over the images of a recording as it is written, with their numbers; None if there is no new one.

    Ends with the last image of the finished file. Raises CaptureError if the finished file is damaged, or the
    unfinished one cannot be read for 5 s.
    """
    shown, readable_s = 0, time.monotonic()
    while True:
        finished = path.is_file() and not part_path(path).exists()
        current = path if finished else part_path(path)
        try:
            with Capture(current) as capture:
                for number in range(shown, len(capture)):
                    yield capture.header, number, capture[number]
                    shown = number + 1
            readable_s = time.monotonic()
        except CaptureError:
            if not current.is_file():
                # Not written yet, or being renamed.
                readable_s = time.monotonic()
            elif finished or time.monotonic() > readable_s + _DAMAGED_S:
                raise
        if finished:
            return
        yield None


class BackgroundView:
    """Display of recorded images in a thread of its own, so that recording never waits for it.

    ``show`` is called with images and their numbers. Its first error is raised when the ``with`` ends.
    """

    def __init__(self, show: Callable[[Frame, int], None]):
        self._show = show
        self._waiting: queue.Queue[tuple[Frame, int] | None] = queue.Queue(_WAITING)
        self._fault: Exception | None = None

    def put(self, frame: Frame, number: int) -> None:
        """Queue an image for display, unless too many wait."""
        if not self._waiting.full():
            self._waiting.put((frame, number))

    def _run(self) -> None:
        while (seen := self._waiting.get()) is not None:
            try:
                self._show(*seen)
            except Exception as error:
                self._fault = self._fault or error

    def __enter__(self) -> Self:
        self._thread = threading.Thread(target=self._run, name="view", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        self._waiting.put(None)
        self._thread.join()
        if self._fault is not None and kind is None:
            raise self._fault
