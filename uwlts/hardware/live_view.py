"""Pages that show a camera at work: a recording while it grows, with its latest image, stripe, warnings and cloud."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import viser

from uwlts.measurement.reconstruction import reconstruct_stripes
from uwlts.model.any_calibration import AnyCalibration
from uwlts.model.errors import CaptureError
from uwlts.storage.calibration_file import loaded_calibration
from uwlts.storage.capture import Capture, part_path
from uwlts.stripe import FoundStripes, extract_stripe

_LONGEST_SIDE_PX = 900


class LivePage:
    """A page with a title. It can be seen from this machine only, unless another ``host`` is given.

    A browser finds it at its ``address``; the next free port is taken where the wanted one is in use.
    """

    def __init__(self, title: str, *, host: str = "127.0.0.1", port: int = 8080):
        self.server = viser.ViserServer(host=host, port=port, verbose=False)
        self.server.gui.configure_theme(control_layout="fixed", control_width="large", show_logo=False)
        self.server.gui.add_markdown(f"# {title}")
        self.address = f"http://{host}:{self.server.get_port()}"

    def close(self) -> None:
        """End the page."""
        self.server.stop()


def small_picture(image: np.ndarray, *, full_dn: int) -> tuple[np.ndarray, float]:
    """The image (H, W) as a picture (h, w, 3) of uint8 with its dark parts raised, and its scale."""
    share = np.sqrt(image.astype(np.float32) / full_dn)
    grey = np.minimum(255 * share, 255).astype(np.uint8)
    scale = min(1.0, _LONGEST_SIDE_PX / max(grey.shape))
    size = (max(1, round(grey.shape[1] * scale)), max(1, round(grey.shape[0] * scale)))
    return cv2.cvtColor(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), cv2.COLOR_GRAY2RGB), scale


_LOOK_S = 0.25
_PACE = 20
_STRIPE_COLOUR = (255, 60, 40)
_FAINT, _MANY = 0.1, 0.05
"""A laser image is faint below this part of the full scale, saturated with more than this part of its lines there."""


@dataclass(frozen=True)
class Seen:
    """One image of a recording: its number, position in mm, light, picture (H, W, 3), stripe, and points (N, 3) in mm.

    ``found`` of the ``lines`` have a stripe; ``remarks`` are warnings. ``planned`` is
    how many images there will be, where that is known, and ``left_s`` the time they take.
    """

    number: int
    stage_mm: float
    laser_on: bool
    picture: np.ndarray
    found: int
    lines: int
    points_mm: np.ndarray
    remarks: tuple[str, ...]
    planned: int | None = None
    left_s: float | None = None


def look(capture: Capture, number: int, calibration: AnyCalibration | None) -> Seen:
    """What one image of a capture shows.

    Raises
    ------
    CalibrationError
        The calibration does not fit the capture.
    """
    frame = capture[number]
    along = capture.header.sensor.camera.stripe_along
    points, (planned, left_s) = np.zeros((0, 3)), _outlook(capture, number)
    if not frame.laser_on:
        picture = _picture(frame.image, capture, None)
        return Seen(number, frame.stage_mm, False, picture, 0, 0, points, (), planned, left_s)
    stripe = extract_stripe(frame.image, stripe_along=along, saturation=capture.header.saturation_dn)
    line = stripe.lines
    if calibration is not None and len(line):
        stripes = FoundStripes(
            np.full(len(line), number), line, stripe.centre_px[line], stripe.amplitude[line], stripe.width_px[line], {}
        )
        points = reconstruct_stripes(capture, stripes, calibration).points_mm
    brightest = frame.image.max(axis=0 if along == "width" else 1)
    full = capture.header.saturation_dn
    remarks = []
    if (brightest >= full).mean() > _MANY:
        remarks.append("saturated on many lines: shorten the exposure")
    elif np.quantile(brightest, 0.98) < _FAINT * full:
        remarks.append("faint: lengthen the exposure, or is the laser lit?")
    if len(line) < 0.05 * len(stripe.status):
        remarks.append("hardly any stripe: is the object in the volume?")
    picture = _picture(frame.image, capture, (line, stripe.centre_px[line]))
    return Seen(
        number, frame.stage_mm, True, picture, len(line), len(stripe.status), points, tuple(remarks), planned, left_s
    )


def _outlook(capture: Capture, number: int) -> tuple[int | None, float | None]:
    """How many images a recording will have, and the time in s that is left, by the pace of the latest ones."""
    planned = capture.header.provenance.get("images")
    if not isinstance(planned, int) or planned <= number:
        return None, None
    first = max(number - _PACE, 0)
    if first == number:
        return planned, None
    pace_s = (capture.time_s[number] - capture.time_s[first]) / (number - first)
    return planned, float(pace_s * (planned - number - 1))


def _picture(image: np.ndarray, capture: Capture, stripe: tuple[np.ndarray, np.ndarray] | None) -> np.ndarray:
    """The image (H, W, 3), uint8, dark parts raised, the stripe's centres marked; small enough to be sent often."""
    picture, scale = small_picture(image, full_dn=capture.header.saturation_dn)
    if stripe is not None:
        line, centre = ((scale * values).astype(int) for values in stripe)
        rows, columns = (centre, line) if capture.header.sensor.camera.stripe_along == "width" else (line, centre)
        last_row, last_column = picture.shape[0] - 1, picture.shape[1] - 1
        picture[np.clip(rows, 0, last_row), np.clip(columns, 0, last_column)] = _STRIPE_COLOUR
    return picture


def images_of(path: Path, calibration: AnyCalibration | None) -> Iterator[Seen | None]:
    """Every image of a recording as it is written; None whenever there is nothing new. Ends after the finished file's.

    Raises
    ------
    CaptureError
        The finished file is damaged.
    CalibrationError
        The calibration does not fit the capture.
    """
    shown = 0
    while True:
        finished = path.is_file() and not part_path(path).exists()
        current = path if finished else part_path(path)
        try:
            with Capture(current) as capture:
                for number in range(shown, len(capture)):
                    yield look(capture, number, calibration)
                    shown = number + 1
        except CaptureError:
            # Not there yet, or just being renamed.
            if finished:
                raise
        if finished:
            return
        yield None


class LiveView(LivePage):
    """The page. It can be seen from this machine only, unless another ``host`` is given."""

    def __init__(self, title: str, *, host: str = "127.0.0.1", port: int = 8080):
        super().__init__(title, host=host, port=port)
        self._words = self.server.gui.add_markdown("waiting for the first image")
        self._image = self.server.gui.add_image(np.zeros((2, 2, 3), np.uint8), label="latest image", format="jpeg")
        self._found = self._lines = self._points = 0

    def show(self, seen: Seen) -> None:
        """Show an image, and its profile in the cloud."""
        self._image.image = seen.picture
        self._found, self._lines = self._found + seen.found, self._lines + seen.lines
        self._points += len(seen.points_mm)
        if len(seen.points_mm):
            depth = seen.points_mm[:, 2]
            self.server.scene.add_point_cloud(
                f"/profiles/{seen.number}",
                seen.points_mm.astype(np.float32),
                _coloured(depth),
                point_size=0.4,
                precision="float32",
            )
            if self._points == len(seen.points_mm):
                self._look_at(seen.points_mm.mean(axis=0))
        remarks = "".join(f"\n\n**{remark}**" for remark in seen.remarks)
        light = "laser" if seen.laser_on else "lamp"
        self._words.content = (
            f"image {seen.number + 1}{_of(seen)}, {light}, stage at {seen.stage_mm:.3f} mm\n\n"
            f"stripe on {self._found:,} of {self._lines:,} profile lines; {self._points:,} points{remarks}"
        )

    def _look_at(self, middle: np.ndarray) -> None:
        """Put the viewers' camera before the first profile, seen as the sensor sees it."""
        self.server.initial_camera.position = tuple(middle + np.array([-60.0, 0.0, -250.0]))
        self.server.initial_camera.look_at = tuple(middle)
        self.server.initial_camera.up = (1.0, 0.0, 0.0)


def _of(seen: Seen) -> str:
    """How many images there will be, and when that is."""
    if seen.planned is None:
        return ""
    left = f", {int(seen.left_s) // 60} min {int(seen.left_s) % 60} s left" if seen.left_s else ""
    return f" of {seen.planned}{left}"


def _coloured(depth_mm: np.ndarray) -> np.ndarray:
    """Colours (N, 3) that repeat every 50 mm of depth."""
    share = (depth_mm / 50 * 255 % 255).astype(np.uint8)
    return cv2.applyColorMap(share[:, None], cv2.COLORMAP_TURBO).reshape(-1, 3)[:, ::-1].copy()


def watch(
    capture: str | Path,
    *,
    calibration: AnyCalibration | str | Path | None = None,
    host: str = "127.0.0.1",
    port: int = 8080,
    report: Callable[[str], None] = print,
) -> None:
    """Show a recording while it grows, in a browser, until Ctrl-C.

    Parameters
    ----------
    capture : str or Path
        Capture that is being recorded, or is to be.
    calibration : Calibration, PolynomialCalibration or path, optional
        Calibration of the sensor, for the cloud.
    host : str
        Address at which the page is served; the default can be reached from this machine only.
    port : int
        Port of the page; the next free one is taken if it is in use.
    report : callable, optional
        Called with lines of text, the first with the address of the page.

    Raises
    ------
    CaptureError, CalibrationError
        As `images_of`, or the calibration cannot be read.
    """
    path, count = Path(capture), 0
    known = None if calibration is None else loaded_calibration(calibration)
    view = LiveView(path.name, host=host, port=port)
    try:
        report(f"open {view.address}; Ctrl-C ends it")
        for seen in images_of(path, known):
            if seen is None:
                time.sleep(_LOOK_S)
            else:
                view.show(seen)
                count += 1
        report(f"{path} is finished with {count} images; the page stays until Ctrl-C")
        threading.Event().wait()
    except KeyboardInterrupt:
        report("closed")
    finally:
        view.close()
