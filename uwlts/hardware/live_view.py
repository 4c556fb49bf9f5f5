"""Pages that show a camera at work: a recording while it grows, with its latest image, stripe, warnings and cloud."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import viser

from uwlts.hardware.page_access import PageAccess, guarded_server, is_local
from uwlts.measurement.reconstruction import reconstruct_stripes
from uwlts.model.any_calibration import AnyCalibration
from uwlts.model.errors import CaptureError
from uwlts.storage.calibration_file import loaded_calibration
from uwlts.storage.capture import Capture, part_path
from uwlts.stripe import FoundStripes, extract_stripe

_LONGEST_SIDE_PX = 900


class LivePage:
    """A page with a title. It can be seen from this machine only, unless another ``host`` is given.

    A browser finds it at its ``address``; the next free port is taken where the wanted one is in use. Everybody who
    opens it there may look; buttons are shown, and obeyed, at the ``operator_address``, which has a token. ``warning``
    is what to say where the page can be seen from other machines.
    """

    def __init__(self, title: str, *, host: str = "127.0.0.1", port: int = 8080):
        access = PageAccess(host)
        self.server = guarded_server(access, port=port)
        self.server.gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        self.server.gui.main_panel.dock_right()
        self.server.gui.add_markdown(f"# {title}")
        named = f"[{host}]" if ":" in host else host
        self.address = f"http://{named}:{self.server.get_port()}"
        self.operator_address = f"{self.address}/?token={access.token}"
        self.warning = None
        if not is_local(host):
            self.warning = (
                f"everybody who reaches {host} in the network can see the page, and what is sent is not encrypted: "
                "safer is the default host with `ssh -L`"
            )

    def operator_button(self, label: str, pressed: Callable[[], None], *, order: float) -> None:
        """A button of the operator, among the page's elements by their ``order``; nobody else has it."""

        # Others never get so far: what their browsers send on connecting is thrown away.
        @self.server.on_client_connect
        def _(client: viser.ClientHandle) -> None:
            client.gui.add_button(label, order=order).on_click(lambda _: pressed())

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


@dataclass(frozen=True, eq=False)
class Shown:
    """One image of a recording: its number, position in mm, light, picture (H, W, 3), stripe, and points (N, 3) in mm.

    ``found`` of the ``lines`` have a stripe; ``remarks`` are warnings. ``planned`` is how many images there will be,
    where that is known, and ``left_s`` the time they take.
    """

    number: int
    stage_mm: float
    laser_on: bool
    picture: np.ndarray
    planned: int | None
    left_s: float | None
    found: int = 0
    lines: int = 0
    points_mm: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    remarks: tuple[str, ...] = ()


def look(capture: Capture, number: int, calibration: AnyCalibration | None) -> Shown:
    """One image of a capture, evaluated; CalibrationError where the calibration does not fit the capture."""
    frame, full = capture[number], capture.header.saturation_dn
    # Dark parts raised, and small enough to be sent often.
    picture, scale = small_picture(frame.image, full_dn=full)
    shown = Shown(number, frame.stage_mm, frame.laser_on, picture, *_outlook(capture, number))
    if not frame.laser_on:
        return shown
    along = capture.header.sensor.camera.stripe_along
    stripe = extract_stripe(frame.image, stripe_along=along, saturation=full)
    line, points = stripe.lines, shown.points_mm
    centre = stripe.centre_px[line]
    if calibration is not None and len(line):
        of_image = np.full(len(line), number)
        stripes = FoundStripes(of_image, line, centre, stripe.amplitude[line], stripe.width_px[line], {})
        points = reconstruct_stripes(capture, stripes, calibration).points_mm
    brightest = frame.image.max(axis=0 if along == "width" else 1)
    remarks = []
    if (brightest >= full).mean() > _MANY:
        remarks.append("saturated on many lines: shorten the exposure")
    elif np.quantile(brightest, 0.98) < _FAINT * full:
        remarks.append("faint: lengthen the exposure, or is the laser lit?")
    if len(line) < 0.05 * len(stripe.status):
        remarks.append("hardly any stripe: is the object in the volume?")
    rows, columns = (
        (scale * values).astype(int) for values in ((centre, line) if along == "width" else (line, centre))
    )
    picture[np.clip(rows, 0, len(picture) - 1), np.clip(columns, 0, picture.shape[1] - 1)] = _STRIPE_COLOUR
    return replace(shown, found=len(line), lines=len(stripe.status), points_mm=points, remarks=tuple(remarks))


def _outlook(capture: Capture, number: int) -> tuple[int | None, float | None]:
    """Number of images that a recording will have, and the time left in s, by the pace of the latest ones."""
    planned = capture.header.provenance.get("images")
    if not isinstance(planned, int) or planned <= number:
        return None, None
    first = max(number - _PACE, 0)
    if first == number:
        return planned, None
    pace_s = (capture.time_s[number] - capture.time_s[first]) / (number - first)
    return planned, float(pace_s * (planned - number - 1))


def images_of(path: Path, calibration: AnyCalibration | None) -> Iterator[Shown | None]:
    """Every image of a recording as it is written; None whenever there is nothing new. Ends after the finished file's.

    CaptureError where the finished file is damaged; CalibrationError where the calibration does not fit the capture.
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

    def show(self, seen: Shown) -> None:
        """Show an image, and its profile in the cloud."""
        self._image.image = seen.picture
        self._found, self._lines = self._found + seen.found, self._lines + seen.lines
        if len(seen.points_mm):
            if not self._points:
                # The viewers' camera stands before the first profile, which is seen as the sensor sees it.
                camera, middle = self.server.initial_camera, seen.points_mm.mean(axis=0)
                camera.position, camera.look_at = tuple(middle + np.array([-60.0, 0.0, -250.0])), tuple(middle)
                camera.up = (1.0, 0.0, 0.0)
            # Colours repeat every 50 mm of depth.
            share = (seen.points_mm[:, 2] / 50 * 255 % 255).astype(np.uint8)
            self.server.scene.add_point_cloud(
                f"/profiles/{seen.number}",
                seen.points_mm.astype(np.float32),
                cv2.applyColorMap(share[:, None], cv2.COLORMAP_TURBO).reshape(-1, 3)[:, ::-1].copy(),
                point_size=0.4,
                precision="float32",
            )
        self._points += len(seen.points_mm)
        of = "" if seen.planned is None else f" of {seen.planned}"
        left = "" if not seen.left_s else f", {int(seen.left_s) // 60} min {int(seen.left_s) % 60} s left"
        remarks = "".join(f"\n\n**{remark}**" for remark in seen.remarks)
        light = "laser" if seen.laser_on else "lamp"
        self._words.content = (
            f"image {seen.number + 1}{of}{left}, {light}, stage at {seen.stage_mm:.3f} mm\n\n"
            f"stripe on {self._found:,} of {self._lines:,} profile lines; {self._points:,} points{remarks}"
        )


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
        if view.warning:
            report(f"warning: {view.warning}")
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
