"""Guided calibration on the page."""

import queue
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from nicegui import ui

from uwlts.calibration.guidance.pose_advice import Coverage
from uwlts.desk.board_page import BoardView, update_regularly
from uwlts.desk.laser_switch import LaserSwitch
from uwlts.desk.server import DeskServer
from uwlts.desk.shown_state import Board, Picture, encode_png
from uwlts.errors import HardwareError
from uwlts.hardware.grbl import GrblStage
from uwlts.hardware.guided.guided_plan import GuidedPlan, load_guided_plan
from uwlts.hardware.guided.operator import ANSWERS
from uwlts.hardware.guided.record import GuidedRecording, guide
from uwlts.hardware.rig import LaserStage

_COVERED, _EMPTY, _DOT = (70, 140, 70), (120, 60, 60), (230, 230, 230)
_MAP_CELL_PX = 48  # size of a cell of the map on the screen


class Ended(Exception):
    """Raised when the operator has ended the recording."""


class BoardScreen:
    """Display of a guided calibration on a board, with answers from buttons; makes a ``switch`` if none is given."""

    def __init__(self, board: Board, switch: LaserSwitch | None = None):
        self._board, self.switch = board, switch or LaserSwitch(board, self.laser_off)
        self._given: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._stage: LaserStage | None = None
        self._ending = self._darkened = False

    def press(self, answer: str) -> None:
        """Store a button's answer."""
        self._given.put(answer)

    def end(self) -> None:
        """End the recording at the next request for an answer; accepted images are kept."""
        self._ending = True

    def laser_off(self) -> None:
        """Switch the laser off at any time; the recording ends and accepted images are kept."""
        if isinstance(stage := self._stage, GrblStage):
            self._darkened = True
            darken(stage, self._board)
        else:
            self._board.say("no laser is connected to this program: switch it off by its own switch", "warning")

    def answer(self) -> str | None:
        """Return the oldest answer not yet returned, or None.

        Raises Ended after `end`, and HardwareError after the laser was switched off.
        """
        if self._ending:
            raise Ended
        if self._darkened:
            # Images of a hand-held target do not need the stage, whose fault would end the recording later.
            raise HardwareError("the laser was switched off by hand, which ends the calibration: continue it later")
        return None if self._given.empty() else self._given.get()

    def request(self, text: str) -> None:
        """Show what the operator should do."""
        self._board.request, self._board.answers = text, ANSWERS

    def live(
        self, image: np.ndarray, *, full_dn: int, points: np.ndarray | None, stripe: np.ndarray | None, remark: str
    ) -> None:
        """Show an image (H, W) with the target's points (N, 2) and the stripe's pixels (N, 2) found in it."""
        self._board.show(Picture(image, full_dn=full_dn, caption=remark, stripe=stripe, points=points))
        if isinstance(self._stage, GrblStage):
            self._board.laser = "on" if self._stage.laser_power > 0 else "flashing"

    def show_coverage(self, coverage: Coverage, pixels: list[np.ndarray]) -> None:
        """Show the coverage, with the points (N, 2) of every image."""
        self._board.coverage = encode_png(draw_coverage(coverage, pixels))

    def add(self, line: str) -> None:
        """Add a line to the log."""
        self._board.say(line)

    def set_stage(self, stage: LaserStage | None) -> None:
        """Set the stage that now switches the laser, or None once it is closed."""
        self._stage = stage
        self.switch.lend(stage)
        self._board.laser = "flashing" if isinstance(stage, GrblStage) else "none"


def darken(stage: GrblStage, board: Board) -> None:
    """Switch the laser off at once, in any state of the stage, and report the result."""
    if stage.darken():
        board.say("laser switched off by hand: unlock the stage if it stood still, else home it", "warning")
    else:
        board.say("the laser CANNOT be switched off: switch its power off before going near", "error")


def draw_coverage(coverage: Coverage, pixels: list[np.ndarray]) -> np.ndarray:
    """Draw a map (h, w, 3) of uint8: covered cells green, others red, and a dot for each point (N, 2)."""
    cells = np.where(coverage.covered[..., None], _COVERED, _EMPTY).astype(np.uint8)
    picture = np.kron(cells, np.ones((_MAP_CELL_PX, _MAP_CELL_PX, 1), np.uint8))
    picture[::_MAP_CELL_PX] = picture[:, ::_MAP_CELL_PX] = 30
    size = np.array(picture.shape[1::-1])
    for points in pixels:
        place = ((points + 0.5) / [coverage.width_px, coverage.height_px] * size).astype(int)
        place = place[((place >= 0) & (place < size)).all(axis=1)]
        picture[place[:, 1], place[:, 0]] = _DOT
    return picture


def answer_buttons(board: Board, press: Callable[[str], None]) -> Callable[[], None]:
    """Build the request to the operator with a button for each answer; return a function that updates it."""
    with ui.column().classes("p-3 gap-2") as asked:
        request = ui.label().classes("text-lg font-bold").props('role="status" aria-live="polite"')
        with ui.row():
            for answer in ANSWERS:
                ui.button(answer, on_click=partial(press, answer))
        ui.label("take: record it as it is; skip: ask for another pose; done: continue with what is recorded").classes(
            "text-xs"
        )

    def refresh() -> None:
        request.set_text(board.request)
        asked.set_visibility(bool(board.answers))

    return refresh


def record_guided(
    plan: str | Path | GuidedPlan,
    out: str | Path,
    *,
    camera: str | None = None,
    stage: str | None = None,
    port: int = 8080,
    refractions: Literal[1, 2] = 2,
    distortion: tuple[str, ...] = ("k1", "k2"),
    resume: bool = False,
    overwrite: bool = False,
    report: Callable[[str], None] = print,
) -> GuidedRecording:
    """Lead through the images of a calibration, and record accepted images in captures beside the calibration.

    Parameters
    ----------
    plan : GuidedPlan or path of a TOML file
        Description of the recording and its devices (docs: calibrate live).
    out : str or Path
        The calibration; the captures have its name with ``-target.h5`` and ``-step.h5``.
    camera : str, optional
        Guided: address of the camera, instead of the plan's.
    stage : str, optional
        Guided: serial port of the stage, instead of the plan's.
    port : int
        Guided: port of the page for the browser; if it is in use, the next free one is taken.
    refractions, distortion
        Options of the calibration that is to be made; see `calibrate`.
    resume : bool
        Guided: continue an earlier recording, also a finished capture of the target that does not suffice.
    overwrite : bool
        Replace existing files; guided, and without ``resume``, earlier captures too.
    report : callable, optional
        Called with lines of text for the operator, who answers on standard input or on the page.

    Returns
    -------
    GuidedRecording
        Captures of target and step standard, the kind of poses, and the evidence that is still missing.

    Raises
    ------
    DescriptionError, RangeError
        The plan cannot be carried out; nothing has moved.
    HardwareError
        Camera, stage or laser fail.
    CalibrationError
        The target does not determine a calibration to judge the step standard.
    OutputError
        A capture exists, or cannot be written.
    """
    described = plan if isinstance(plan, GuidedPlan) else load_guided_plan(Path(plan))
    described = described.with_connection(camera=camera, port=stage)
    described.camera_address()
    board = Board(described.title)
    board.phase("guided calibration")
    screen = BoardScreen(board)

    def build(board: Board, operator: bool) -> None:
        view = BoardView(board)
        view.header()
        with ui.element("main").classes("desk guided"):
            view.image()
            with ui.element("section").classes("cloud"):
                refresh = answer_buttons(board, screen.press) if operator else lambda: None
                view.coverage()
            view.log()
        update_regularly(lambda: (view.refresh(), refresh()))

    with DeskServer(board, build=build, port=port, switch=screen.switch) as server:
        report(f"open {server.operator_address}; Ctrl-C ends it, accepted images are kept")
        return guide(
            described,
            Path(out),
            screen,
            refractions=refractions,
            distortion=distortion,
            resume=resume,
            overwrite=overwrite,
            report=report,
        )
