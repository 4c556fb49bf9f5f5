"""The desk: all of an operator's work on one page."""

import asyncio
import threading
from collections.abc import Awaitable, Callable
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from urllib.parse import quote

import numpy as np
from nicegui import ui
from nicegui.elements.mixins.disableable_element import DisableableElement
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response

from uwlts.desk.analyses import Analyses
from uwlts.desk.analysis_panel import AnalysisPanel
from uwlts.desk.board_page import BoardView, NumberField, build_board, update_regularly
from uwlts.desk.desk_files import find_file, guess_kind, list_files, new_path
from uwlts.desk.guided import answer_buttons
from uwlts.desk.guided_plan import load_guided_plan
from uwlts.desk.instrument import Instrument, InstrumentState
from uwlts.desk.measure_panel import MeasurePanel, Measuring
from uwlts.desk.server import DeskServer
from uwlts.desk.shown_state import FIELDS, Board, point_table
from uwlts.errors import DescriptionError, Error
from uwlts.files.writing import refuse_unsuitable
from uwlts.hardware.scan_plan import ScanPlan, StagePlan, load_plan
from uwlts.model.library import validate_description
from uwlts.report.file_description import describe
from uwlts.storage.calibration_file import load_calibration
from uwlts.storage.capture import part_path
from uwlts.storage.cloud import PointCloud
from uwlts.storage.cloud_files import read_thinned_cloud

_LIST_S = 2.0  # period in which the list of files is read again
_MOST_SHOWN = 300_000  # points, fluent on a tablet
_MOST_OPENED = 5_000_000  # points of a file that are kept in memory for measurements
_JOGS_MM = (-10.0, -1.0, -0.1, 0.1, 1.0, 10.0)  # steps of the buttons that move the stage
_FREE = (InstrumentState.READY, InstrumentState.LOCKED)
_RUNNING = (InstrumentState.SCANNING, InstrumentState.PAUSED)


def serve_desk(
    folder: str | Path = ".",
    *,
    plan: str | Path | None = None,
    host: str = "127.0.0.1",
    port: int = 8080,
    report: Callable[[str], None] = print,
) -> None:
    """Serve the operator's page until Ctrl-C: connect, view, calibrate, scan, reconstruct and measure in a browser.

    The address with the token is the operator's; everybody who can reach the other one may view. The page works without
    internet.

    Parameters
    ----------
    folder : str or Path
        Folder with plans, calibrations, captures and clouds, by default the current one. Results are written there.
    plan : str or Path, optional
        Plan of a scan (docs: scan) to begin with; others can be chosen on the page.
    host : str
        Address of the page; the default can be reached from this machine only.
    port : int
        Port of the page; if it is in use, the next free one is taken.
    report : callable, optional
        Called with lines of text, the first with the operator's address of the page.

    Raises
    ------
    DescriptionError
        There is no such folder, or the plan is not valid.
    SetupError
        The page cannot be served.
    """
    place = Path(folder)
    if not place.is_dir():
        raise DescriptionError(f"there is no folder {place}: give one for captures and results")
    begun = None if plan is None else load_plan(Path(plan))
    board = Board(f"desk: {place.resolve().name}")
    with closing(Instrument(board)) as instrument:
        work = _Desk(place, board, instrument, None if plan is None else Path(plan), begun)
        with (
            closing(work.analyses),
            DeskServer(board, build=work.build, host=host, port=port, switch=instrument.switch) as server,
        ):
            try:
                work.serve_files(server)
                report(f"open {server.operator_address} to work, {server.address} to look; Ctrl-C ends it")
                if server.warning:
                    report(f"warning: {server.warning}")
                threading.Event().wait()
            except KeyboardInterrupt:
                # Before the page's server, whose end may take a while.
                instrument.close()
                report("closed")


@dataclass(eq=False)
class _Desk:
    """State shared by all browsers: the folder, the instrument, the chosen plan and the opened cloud."""

    folder: Path
    board: Board
    instrument: Instrument
    plan_path: Path | None
    plan: ScanPlan | None

    def __post_init__(self) -> None:
        self.measuring, self.analyses = Measuring(), Analyses(self.folder, self.board, self._show_result)

    def serve_files(self, server: DeskServer) -> None:
        """Add a route for the files of the folder; viewers may fetch reports only."""

        @server.app.get("/files/{name}")
        def file(name: str, request: Request) -> Response:
            try:
                path = find_file(self.folder, name)
            except Error as error:
                return PlainTextResponse(f"{error}\n", 404)
            if guess_kind(name) != "report" and not server.is_operator(request):
                return PlainTextResponse("only the operator may fetch this\n", 403)
            # Scripts in a report must not press the operator's buttons.
            return FileResponse(path, headers={"Content-Security-Policy": "sandbox allow-scripts allow-popups"})

    def build(self, board: Board, operator: bool) -> None:
        """Build the page for a browser."""
        if operator:
            _OperatorPage(self).build()
        else:
            build_board(board, False)

    def plans(self, load: Callable[[Path], object]) -> dict[str, str]:
        """Return the names of the valid plans that ``load`` reads, by their paths."""
        paths = [self.folder / file.name for file in list_files(self.folder) if file.kind == "description"]
        if self.plan_path is not None and self.plan_path not in paths:
            paths.append(self.plan_path)
        found = {}
        for path in paths:
            with suppress(Error):
                load(path)
                found[str(path)] = path.name
        return found

    def show_cloud(self, name: str, cloud: PointCloud, *, of: int | None = None) -> None:
        """Show a cloud, a sample ``of`` that many points, thinned if it is large, and make it the one to measure.

        A closer view shows more of its points.
        """

        def closer(low: np.ndarray, high: np.ndarray) -> np.ndarray:
            inside = np.flatnonzero(np.all((cloud.points_mm >= low) & (cloud.points_mm <= high), axis=1))
            found = cloud.select(inside[:: -(-len(inside) // _MOST_SHOWN) or 1])
            return point_table(found.points_mm, **_choose_fields(found))

        self.measuring.open(cloud)
        self.board.detail = None
        self.board.cloud.clear()
        self.board.cloud_name, self.board.deviates = name, cloud.deviation_mm is not None
        shown, total = cloud.select(slice(None, None, -(-len(cloud) // _MOST_SHOWN) or 1)), of or len(cloud)
        self.board.cloud.add(shown.points_mm, total, **_choose_fields(shown))
        self.board.detail = closer if total > len(shown) else None

    def open_cloud(self, name: str) -> None:
        """Read a cloud of the folder, a sample of a very large one, and show it."""
        path = find_file(self.folder, name)
        cloud, total = read_thinned_cloud(path, _MOST_OPENED)
        if total > len(cloud):
            self.board.say(f"{name} has {total:,} points: an even sample of {len(cloud):,} is measured", "warning")
        self.show_cloud(name, cloud, of=total)

    def _show_result(self, path: Path) -> None:
        """Show the cloud of an analysis, unless a scan is shown."""
        if self.instrument.state in _RUNNING:
            return
        try:
            self.open_cloud(path.name)
        except Error as error:
            self.board.say(str(error), "error")


def _choose_fields(cloud: PointCloud) -> dict[str, np.ndarray | None]:
    """Return fields (N,) for colouring a cloud's points."""
    return {field: cloud.field_values(field) for field in FIELDS}


class _OperatorPage:
    """The operator's page in one browser."""

    def __init__(self, desk: _Desk):
        self._desk, self._instrument, self._board = desk, desk.instrument, desk.board
        self._view = BoardView(desk.board, picked=lambda place: self._measure.show_picked(place))
        self._only: list[tuple[DisableableElement, tuple[InstrumentState, ...]]] = []
        self._analyses = AnalysisPanel(desk.folder, desk.analyses, button=self._offer, mark=self._view.mark)
        self._measure = MeasurePanel(desk.folder, desk.board, desk.measuring, button=self._offer, mark=self._view.mark)
        self._refreshed = 0
        self._files: tuple[object, ...] = ()

    def build(self) -> None:
        """Build the page."""
        view = self._view
        view.header()
        with ui.element("main").classes("desk"):
            view.image()
            view.cloud()
            with ui.element("section").classes("tools").props('aria-label="controls"'):
                parts = {
                    "Connect": self._connect_part,
                    "Stage": self._show_stage_part,
                    "Calibrate": self._show_calibrate_part,
                    "Scan": self._scan_part,
                    "Files": self._show_files_part,
                    "Inspect": self._analyses.build,
                    "Measure": self._measure.build,
                }
                with ui.tabs().props("dense no-caps align=left") as self._tabs:
                    for name in parts:
                        ui.tab(name)
                with ui.tab_panels(self._tabs, value="Connect", animated=False).classes("w-full").props("keep-alive"):
                    for name, part in parts.items():
                        with ui.tab_panel(name).classes("gap-2"):
                            part()
            view.log()
        update_regularly(self._refresh)
        ui.timer(_LIST_S, self._update_list)

    def _offer(
        self, label: str, press: Callable[[], object], states: tuple[InstrumentState, ...] | None = None
    ) -> ui.button:
        """Add a button whose errors are shown, and which is enabled in some states only."""

        async def pressed() -> None:
            try:
                done = press()
                if isinstance(done, Awaitable):
                    await done
            except Error as error:
                self._board.say(str(error), "error")
                ui.notify(str(error), type="negative", multi_line=True, timeout=10_000)

        button = ui.button(label, on_click=pressed)
        if states is not None:
            self._only.append((button, states))
        return button

    def _refresh(self) -> None:
        if ui.context.client.has_socket_connection:
            self._instrument.attend()
        self._view.refresh()
        self._show_request()
        self._analyses.refresh()
        self._measure.refresh()
        self._light.value = self._instrument.light or "none"
        if (shown := self._read_exposure()) != self._exposed:
            # Not while the operator types in it.
            self._exposed, self._exposure.value = shown, shown[1]
        # A new page is refreshed twice before its buttons are enabled: text typed before the connection arrives a
        # moment after it, and a button pressed in between would be obeyed first.
        self._refreshed += 1
        for element, states in self._only:
            element.set_enabled(self._refreshed > 2 and self._instrument.state in states)

    # Connect

    def _connect_part(self) -> None:
        device, ask = self._instrument, self._instrument.ask
        plans, plan = self._desk.plans(load_plan), self._desk.plan
        chosen = None if self._desk.plan_path is None else str(self._desk.plan_path)
        # Here and below, values are passed to the constructors: a value set later reaches the browser as a message, and
        # could overwrite what the operator has typed by then.
        camera, stage = _read_addresses(plan) if plan else ("", "")
        self._plan = ui.select(plans, label="plan of the scan", value=chosen, on_change=self._choose).classes("w-full")
        kinds = "gige:NAME, replay:FILE"
        self._camera = ui.input("camera", value=camera, placeholder=kinds).classes("w-full")
        self._stage = ui.input("stage", value=stage, placeholder="/dev/ttyACM0; empty: none").classes("w-full")
        with ui.row():
            self._offer("connect", self._connect, (InstrumentState.DISCONNECTED, *_FREE))
            self._offer("disconnect", partial(ask, device.disconnect), _FREE).props("outline")
        ui.separator()
        ui.label("live image").classes("text-sm")
        self._light = ui.toggle({"lamp": "lamp", "laser": "laser", "none": "stop"}, value="none")
        self._light.on_value_change(lambda event: self._look(event.value))
        self._only.append((self._light, _FREE))
        self._exposed = self._read_exposure()
        with ui.element("div").classes("fields"):
            self._exposure = NumberField("exposure, ms", value=self._exposed[1], min=0.001, step=0.1, format="%.3g")
            self._exposure.on("change", self._expose)
            self._offer("find exposure", partial(ask, device.find_exposure), (InstrumentState.READY,)).props("outline")
        ui.label("The laser is on only while an image is exposed.").classes("text-xs")

    def _choose(self) -> None:
        if not self._plan.value or Path(self._plan.value) == self._desk.plan_path:
            return
        try:
            plan = load_plan(Path(self._plan.value))
        except Error as error:
            self._board.say(str(error), "error")
            return
        self._desk.plan_path, self._desk.plan = Path(self._plan.value), plan
        self._camera.value, self._stage.value = _read_addresses(plan)
        stage = plan.stage
        self._start.value, self._step.value, self._number.value = stage.start_mm, stage.step_mm, stage.count

    def _require_plan(self) -> ScanPlan:
        if self._desk.plan is None:
            raise DescriptionError("choose a plan first; valid ones of the folder are offered (docs/how-to/scan.md)")
        return self._desk.plan

    def _connect(self) -> None:
        addresses = {"camera": self._camera.value or "", "stage": self._stage.value or None}
        self._instrument.ask(self._instrument.connect, self._require_plan(), **addresses)

    def _look(self, light: str) -> None:
        wanted = None if light == "none" else "laser" if light == "laser" else "lamp"
        # The toggle follows the instrument, too.
        if wanted != self._instrument.light:
            self._instrument.show_light(wanted)

    def _read_exposure(self) -> tuple[str | None, float]:
        light = self._instrument.light
        return light, self._instrument.exposure_ms[light or "lamp"]

    def _expose(self) -> None:
        light, value = self._instrument.light, self._exposure.value
        if light is not None and value and value > 0:
            self._instrument.exposure_ms[light] = float(value)

    # Stage

    def _show_stage_part(self) -> None:
        device, ask = self._instrument, self._instrument.ask
        with ui.row():
            self._offer("home", partial(ask, device.home), _FREE)
            self._offer("unlock", partial(ask, device.unlock), _FREE).props("outline")
        ui.label("Unlock only where nothing moved since the position was known.").classes("text-xs")
        with ui.row().classes("gap-1"):
            for by in _JOGS_MM:
                label = f"{by:+g}".replace("-", "−")
                self._offer(label, partial(ask, partial(device.jog, by)), (InstrumentState.READY,)).props(
                    f'outline dense aria-label="move by {by:+g} mm"'
                )
        with ui.row().classes("items-center"):
            place = NumberField("position, mm", value=0.0, format="%.3f")
            self._offer("move", lambda: ask(device.move, float(place.value or 0.0)), (InstrumentState.READY,))

    # Calibrate

    def _show_calibrate_part(self) -> None:
        self._guided_plan = ui.select(self._desk.plans(load_guided_plan), label="plan of the calibration").classes(
            "w-full"
        )
        with ui.element("div").classes("fields"):
            self._calibration_name = ui.input("name of the calibration", value="calibration")
            self._replace = ui.checkbox("replace existing")
        with ui.row():
            self._offer("begin", lambda: self._calibrate(resume=False), (InstrumentState.DISCONNECTED, *_FREE))
            self._offer(
                "continue it", lambda: self._calibrate(resume=True), (InstrumentState.DISCONNECTED, *_FREE)
            ).props("outline")
        self._show_request = answer_buttons(self._board, self._instrument.answer)
        self._offer("stop", self._instrument.stop, (InstrumentState.BUSY,)).props("color=warning")
        self._view.coverage()

    def _calibrate(self, *, resume: bool) -> None:
        if not self._guided_plan.value:
            raise DescriptionError("choose a plan of a calibration first (docs/how-to/calibrate-live.md)")
        plan = load_guided_plan(Path(self._guided_plan.value))
        plan = plan.with_connection(camera=self._camera.value or None, port=self._stage.value or None)
        out = new_path(self._desk.folder, self._calibration_name.value or "", suffix=".json")
        overwrite = bool(self._replace.value)
        refuse_unsuitable(out, overwrite=overwrite)
        self._instrument.ask(self._instrument.calibrate, plan, out, resume=resume, overwrite=overwrite)

    # Scan

    def _scan_part(self) -> None:
        plan = self._desk.plan
        stage = None if plan is None else plan.stage
        start, step, count = (None, None, None) if stage is None else (stage.start_mm, stage.step_mm, stage.count)
        with ui.element("div").classes("fields"):
            self._start = NumberField("first position, mm", value=start, format="%.3f")
            self._step = NumberField("step, mm", value=step, format="%.4f")
            self._number = NumberField("positions", value=count, min=1, precision=0)
        self._extent = ui.label().classes("text-sm")
        self._show_extent()
        for each in (self._start, self._step, self._number):
            each.on_value_change(self._show_extent)
        self._calibration = ui.select([], label="calibration for the cloud", clearable=True).classes("w-full")
        self._calibration.on_value_change(lambda event: self._use_calibration(event.value))
        with ui.element("div").classes("fields"):
            self._out = ui.input("name of the capture", value="scan")
            self._overwrite = ui.checkbox("replace existing")
        with ui.row():
            self._offer("start", lambda: self._record(resume=False), (InstrumentState.READY,))
            self._offer("continue interrupted", lambda: self._record(resume=True), (InstrumentState.READY,)).props(
                "outline"
            )
        with ui.row():
            self._offer("pause", self._instrument.pause, (InstrumentState.SCANNING,))
            self._offer("resume", self._instrument.resume, (InstrumentState.PAUSED,))
            self._offer("stop", self._instrument.stop, _RUNNING).props("color=warning")

    def _use_calibration(self, name: str | None) -> None:
        """Use a calibration for the profiles of live images."""
        try:
            self._instrument.calibration = load_calibration(self._desk.folder / name) if name else None
        except Error as error:
            self._board.say(str(error), "error")

    def _show_extent(self) -> None:
        start, step, count = self._start.value, self._step.value, self._number.value
        if start is not None and step is not None and count is not None:
            self._extent.set_text(f"{start:g} to {start + step * (count - 1):g} mm")

    def _record(self, *, resume: bool) -> None:
        plan = self._require_plan()
        start, step, count = self._start.value, self._step.value, self._number.value
        if start is None or step is None or count is None:
            raise DescriptionError("give the first position, the step and the number of positions")
        moved = {"start_mm": start, "step_mm": step, "count": count}
        stage = validate_description(StagePlan, plan.stage.model_dump() | moved, "the scan")
        out = new_path(self._desk.folder, self._out.value or "", suffix=".h5")
        overwrite = bool(self._overwrite.value)
        if out.exists() and not overwrite and not resume:
            raise DescriptionError(f"{out.name} exists: give another name, or tick 'replace'")
        if part_path(out).is_file() and not resume and not overwrite:
            raise DescriptionError(f"{out.name} was interrupted: continue it, give another name, or tick 'replace'")
        known = self._calibration.value
        self._desk.measuring.open(None)
        self._instrument.ask(
            self._instrument.scan,
            plan.model_copy(update={"stage": stage}),
            out,
            calibration=self._desk.folder / known if known else None,
            resume=resume,
            overwrite=overwrite and not resume,
        )

    # Files

    def _show_files_part(self) -> None:
        self._rows = ui.column().classes("w-full gap-1")
        self._update_list()

    def _update_list(self) -> None:
        """Update the list of files and the choices if the folder has changed."""
        try:
            files = list_files(self._desk.folder)
        except Error as error:
            self._board.say(str(error), "error")
            return
        # A growing recording is not a new file.
        known = tuple((file.name, None if file.kind == "interrupted capture" else file.time_s) for file in files)
        if known == self._files:
            return
        self._files = known
        calibrations = [file.name for file in files if file.kind == "calibration"]
        self._calibration.set_options(calibrations, value=self._calibration.value)
        for choice, load in ((self._plan, load_plan), (self._guided_plan, load_guided_plan)):
            choice.set_options(self._desk.plans(load), value=choice.value)
        self._analyses.set_files()
        self._rows.clear()
        with self._rows:
            for file in files:
                with ui.row().classes("w-full items-center no-wrap gap-2 text-sm"):
                    address = f"files/{quote(file.name)}"
                    ui.link(file.name, address).props("download").classes("grow break-all font-mono download")
                    size = f"{file.size / 1e6:.1f} MB" if file.size >= 1e5 else f"{file.size / 1e3:.1f} kB"
                    ui.label(f"{file.kind}, {size}").classes("text-xs text-slate-500")
                    name = file.name
                    if file.kind == "report":
                        ui.link("open", address, new_tab=True)
                        continue
                    if file.kind == "cloud":
                        self._offer("show", partial(self._show, name)).props("flat dense")
                    if file.kind == "measured values":
                        self._offer("list", partial(self._measure.open, name)).props("flat dense")
                    if file.kind == "capture":
                        self._offer("reconstruct", partial(self._reconstruct, name)).props("flat dense")
                    self._offer("about", partial(self._show_about, name)).props("flat dense")

    async def _show(self, name: str) -> None:
        await asyncio.to_thread(self._desk.open_cloud, name)
        self._view.mark([])

    async def _show_about(self, name: str) -> None:
        text = await asyncio.to_thread(describe, find_file(self._desk.folder, name))
        with ui.dialog() as dialog, ui.card().classes("max-w-none"):
            ui.label(name).classes("font-bold")
            ui.label(text).classes("whitespace-pre-wrap font-mono text-sm")
            ui.button("close", on_click=dialog.close)
        dialog.open()

    def _reconstruct(self, name: str) -> None:
        known = self._calibration.value
        if not known:
            raise DescriptionError("choose the calibration first, under Scan")
        self._desk.analyses.start("reconstruct", {"capture": name, "calibration": known}, name="", overwrite=False)
        # Progress and result are there.
        self._tabs.set_value("Inspect")


def _read_addresses(plan: ScanPlan) -> tuple[str, str]:
    """Return the addresses of the camera and the stage."""
    return plan.camera or "", plan.stage.port or ""
