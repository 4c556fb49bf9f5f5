"""Page of the board: state, live image, cloud (drawn by three.js) and log; the desk adds its controls."""

import math
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np
from nicegui import ui
from nicegui.element import Element

from uwlts.desk.shown_state import FIELDS, KEPT_LINES, Board, LaserState, Picture
from uwlts.pages.cloud_figure import COLOURS, THREE, VIEW


class NumberField(ui.number):
    """A field for a number that keeps what was typed.

    NiceGUI's field is rewritten when it loses the focus, possibly with a number older than what was typed before the
    page was connected.
    """

    def sanitize(self) -> None:
        """Do nothing: limits are checked where the number is used."""


_REFRESH_S = 0.2  # five times a second looks immediate
_LASER: dict[LaserState, tuple[str, str]] = {
    "none": ("no laser", "bg-slate-600"),
    "off": ("laser off", "bg-green-700"),
    "flashing": ("laser ON for images", "bg-red-600"),
    "on": ("laser ON", "bg-red-600"),
    "unknown": ("laser may be ON: switch its power off", "bg-red-600"),
}
_STYLE = Path(__file__).with_name("desk.css")


class BoardView:
    """Parts of the page that show a board, in one browser; `refresh` updates them."""

    def __init__(self, board: Board, *, picked: Callable[[np.ndarray], None] | None = None):
        self._board, self._picked = board, picked
        self._pictures, self._coverage, self._line, self._named = -1, b"", -1, ""
        # Parts that some pages lack.
        self._cloud: CloudView | None = None
        self._map: ui.element | None = None

    def header(self) -> AbstractContextManager[object]:
        """Build the top bar and return it, so that controls can be added."""
        ui.add_css(_STYLE)
        ui.query(".nicegui-content").classes("p-2")
        bar = ui.header().classes("items-center py-2 gap-4 bg-slate-800")
        with bar:
            ui.label(self._board.title).classes("text-lg font-bold")
            self._laser = ui.label().props('role="status"').classes("px-3 py-1 rounded font-bold")
            with ui.column().classes("grow gap-0"):
                self._phase = ui.label().props('role="status" aria-live="polite"')
                self._bar = ui.linear_progress(0, show_value=False, size="6px").props("instant-feedback")
        return bar

    def image(self) -> None:
        """Build the latest image with its caption and histogram."""
        with ui.element("section").classes("image").props('aria-label="latest image"'):
            self._image = ui.element("img").props('alt="latest image"')
            self._image.set_visibility(False)
            self._caption = ui.label("no image yet: connect a camera, then press lamp or laser").classes("text-sm")
            self._histogram = ui.html("", sanitize=False).classes("histogram")

    def coverage(self) -> None:
        """Build the map of the image area covered in a guided calibration."""
        with ui.column().classes("p-3") as self._seen:
            ui.label("parts of the image in which the target was seen")
            self._map = ui.element("img").props('alt="coverage of the image"').style("max-height: 40vh")
        self._seen.set_visibility(False)

    def cloud(self) -> None:
        """Build the cloud, with a choice of colours."""
        with ui.element("section").classes("cloud").props('aria-label="cloud"'):
            shown = self._cloud = CloudView(self._picked)
            with ui.row().classes("items-center px-2 py-1 gap-x-3 gap-y-0"):
                self._colours = ui.select(["depth", *FIELDS], value="depth", label="colour").props("dense")
                self._colours.classes("w-32").on_value_change(lambda event: shown.set_parameter("field", event.value))
                ui.button("fit", on_click=shown.fit).props("flat dense")
                self._count = ui.label().classes("text-sm")

    def log(self) -> None:
        """Build the log, the latest line first."""
        self._log = ui.element("section").classes("log").props('aria-label="log" role="log" tabindex="0"')

    def mark(self, places_mm: Sequence[np.ndarray]) -> None:
        """Mark places (3,) in the cloud."""
        if self._cloud is not None:
            self._cloud.set_parameter("marks", [place.tolist() for place in places_mm])

    def refresh(self) -> None:
        """Show what has changed."""
        board = self._board
        text, colour = _LASER[board.laser]
        self._laser.set_text(text)
        self._laser.classes(remove=" ".join(each for _, each in _LASER.values()), add=colour)
        self._phase.set_text(_describe_progress(board))
        progress = board.progress
        self._bar.set_value(progress.done / progress.total if progress.total else 0.0)
        waiting = progress.busy and not progress.total
        self._bar.props(add="indeterminate" if waiting else None, remove=None if waiting else "indeterminate")
        if board.pictures != self._pictures and (picture := board.picture) is not None:
            self._pictures = board.pictures
            self._image.props(f'src="picture.jpg?{self._pictures}"').set_visibility(True)
            self._caption.set_text(picture.caption)
            self._histogram.set_content(_draw_histogram(picture))
        if board.coverage is not None and board.coverage is not self._coverage:
            self._coverage = board.coverage
            if self._map is not None:
                self._map.props(f'src="coverage.png?{time.monotonic_ns()}"')
                self._seen.set_visibility(True)
        if self._cloud is not None:
            self._cloud.set_parameter("version", board.cloud.version)
            self._cloud.set_parameter("closer", board.detail is not None)
            name = f"{board.cloud_name}: " if board.cloud_name else ""
            self._count.set_text(f"{name}{board.cloud.total:,} points")
            if board.cloud_name != self._named:
                # An inspected cloud is shown as in its report.
                self._named = board.cloud_name
                self._colours.set_value("deviation" if board.deviates else "depth")
        for line in board.lines(self._line):
            self._line = line.number
            kind = "" if line.kind == "note" else f"{line.kind}: "
            when = time.strftime("%H:%M:%S", time.localtime(line.time_s))
            with self._log:
                shown = ui.label(f"{when}  {kind}{line.text}").classes(line.kind)
            shown.move(target_index=0)
            if len(self._log.default_slot.children) > KEPT_LINES:
                self._log.remove(-1)


def _describe_progress(board: Board) -> str:
    progress, place = board.progress, board.position_mm
    text = progress.phase
    if progress.total is not None:
        text += f", {progress.done} of {progress.total}"
    if progress.left_s is not None:
        text += f", {math.ceil(progress.left_s) // 60} min {math.ceil(progress.left_s) % 60} s left"
    return text if place is None else f"{text} · stage at {place:.3f} mm"


def _draw_histogram(picture: Picture) -> str:
    """Return bars of the grey values as HTML, on a logarithmic scale from 1e-5 of all pixels."""
    heights = np.clip(1 + np.log10(np.maximum(picture.histogram, 1e-5)) / 5, 0.0, 1.0)
    bars = "".join(
        f'<rect x="{4 * k}" y="{40 - 40 * height:.1f}" width="3.4" height="{40 * height:.1f}"/>'
        for k, height in enumerate(heights.tolist())
    )
    saturated = "" if picture.saturated is None else f"{100 * picture.saturated:.1f} % of the lit lines saturated"
    return (
        f'<svg viewBox="0 0 {4 * len(heights)} 40" style="width:100%;height:60px" role="img" '
        f'aria-label="histogram of grey values"><g fill="#456">{bars}</g></svg>'
        f'<div style="display:flex;justify-content:space-between;font-size:12px"><span>grey value 0</span>'
        f"<span>{saturated}</span><span>full scale</span></div>"
    )


def build_board(board: Board, operator: bool) -> None:
    """Build the page for viewers."""
    view = BoardView(board)
    view.header()
    with ui.element("main").classes("desk looking"):
        view.image()
        view.cloud()
        view.log()
    update_regularly(view.refresh)


def update_regularly(refresh: Callable[[], object]) -> None:
    """Update a browser's page now, and then several times a second."""
    refresh()
    ui.timer(_REFRESH_S, refresh)


class CloudView(Element, component=VIEW, esm={"nicegui-scene": str(THREE.parent)}, default_classes="w-full"):
    """View of the board's cloud; ``picked`` is called with the position (3,) in mm of a clicked point."""

    def __init__(self, picked: Callable[[np.ndarray], None] | None = None):
        super().__init__()
        self._props |= {"field": "depth", "version": -1, "marks": [], "fit": 0, "closer": False, "deviations": COLOURS}
        if picked is not None:
            self.on("pick", lambda event: picked(np.array(event.args["at"], float)))

    def fit(self) -> None:
        """Fit the whole cloud into the view."""
        self.set_parameter("fit", self._props["fit"] + 1)

    def set_parameter(self, name: str, value: object) -> None:
        """Set a parameter of the view in the browser: cloud's version, field of the colours, marked places in mm.

        ``closer`` states whether more points can be fetched for a closer view.
        """
        if self._props[name] != value:
            self._props[name] = value
            self.update()
