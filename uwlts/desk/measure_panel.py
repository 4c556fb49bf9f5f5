"""Tab of the operator's page for measurements: in the cloud, in sections and live profiles, and the list of values."""

import asyncio
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from html import escape
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from nicegui import ui
from nicegui.events import MouseEventArguments

from uwlts.desk.board_page import NumberField
from uwlts.desk.desk_files import find_file, new_path
from uwlts.desk.shown_state import Board
from uwlts.errors import DescriptionError, Error
from uwlts.inspection.picking import (
    MEASURED_ENDINGS,
    MeasuredValue,
    MeasuredValues,
    PickedMeasurement,
    Section,
    Shape,
    cut_section,
    find_nearest_point,
    fit_shape_near,
    measure_length,
    measure_step,
    read_measured,
)
from uwlts.report.findings_page import write_measured
from uwlts.storage.cloud import PointCloud
from uwlts.storage.cloud_files import name_cloud

_WIDTH, _HEIGHT = 360, 220
_LEFT, _RIGHT, _TOP, _BOTTOM = 52, 10, 10, 36
"""Size of the plot and of its margins, px."""
_TICKS = 5  # wanted number of ticks of an axis
_MOST_POINTS = 3000  # points that are drawn; more would overlap
_MARGIN = 0.05  # margin around the points as a fraction of their range


@dataclass(frozen=True, eq=False)
class Plot:
    """Points (N,), or the upper edges of bars, over the horizontal axis."""

    # (N,); coordinates; of bars the middles and the heights.
    across: np.ndarray
    up: np.ndarray
    # Names of the axes, with units.
    across_label: str
    up_label: str
    bar_width: float | None = None  # width of bars; None: points
    downwards: bool = False  # True if the vertical axis increases downwards
    marks: Sequence[tuple[float, float]] = ()  # marked places

    @property
    def across_range(self) -> tuple[float, float]:
        """Range of the horizontal axis."""
        half = (self.bar_width or 0.0) / 2
        return _widen(float(self.across.min()) - half, float(self.across.max()) + half)

    def place_of(self, pixel: float) -> float:
        """Return the horizontal coordinate of a pixel column."""
        low, high = self.across_range
        return low + (pixel - _LEFT) / (_WIDTH - _LEFT - _RIGHT) * (high - low)

    def draw(self) -> str:
        """Return the plot as the content of an SVG element of 360 x 220 px."""
        x = _make_scale(*self.across_range, _LEFT, _WIDTH - _RIGHT)
        ends = (_TOP, _HEIGHT - _BOTTOM) if self.downwards else (_HEIGHT - _BOTTOM, _TOP)
        # The axis of bars begins at zero.
        up_range = _widen(float(self.up.min()), float(self.up.max()))
        if self.bar_width is not None:
            up_range = 0.0, max(1.0, (1 + _MARGIN) * float(self.up.max()))
        y = _make_scale(*up_range, *ends)
        parts = [f'<rect width="{_WIDTH}" height="{_HEIGHT}" fill="white"/>']
        for value, text in ticks(*self.across_range):
            at = x(value)
            parts.append(_draw_line(at, _TOP, at, _HEIGHT - _BOTTOM, "#dde2e8"))
            parts.append(_write(at, _HEIGHT - _BOTTOM + 13, text, "middle"))
        for value, text in ticks(*up_range):
            at = y(value)
            parts.append(_draw_line(_LEFT, at, _WIDTH - _RIGHT, at, "#dde2e8"))
            parts.append(_write(_LEFT - 4, at + 4, text, "end"))
        parts.append(_write((_LEFT + _WIDTH - _RIGHT) / 2, _HEIGHT - 6, self.across_label, "middle"))
        middle = (_TOP + _HEIGHT - _BOTTOM) / 2
        parts.append(f'<g transform="rotate(-90 11 {middle:.1f})">{_write(11, middle, self.up_label, "middle")}</g>')
        every = slice(None, None, 1 if self.bar_width else -(-len(self.across) // _MOST_POINTS))
        u, v = x(self.across[every]), y(self.up[every])
        if self.bar_width is None:
            path = "".join(f"M{a:.1f} {b:.1f}h0" for a, b in zip(u.tolist(), v.tolist(), strict=True))
            parts.append(f'<path d="{path}" stroke="#3573b1" stroke-width="2.2" stroke-linecap="round"/>')
        else:
            wide, base = 0.9 * (x(self.bar_width) - x(0.0)), y(0.0)
            path = "".join(
                f"M{a - wide / 2:.1f} {base:.1f}V{b:.1f}h{wide:.1f}V{base:.1f}z"
                for a, b in zip(u.tolist(), v.tolist(), strict=True)
            )
            parts.append(f'<path d="{path}" fill="#3573b1"/>')
        for across, up in self.marks:
            parts.append(_draw_line(x(across), _TOP, x(across), _HEIGHT - _BOTTOM, "#b5303c"))
            parts.append(f'<circle cx="{x(across):.1f}" cy="{y(up):.1f}" r="4" fill="none" stroke="#b5303c"/>')
        return "".join(parts)


def ticks(low: float, high: float) -> list[tuple[float, str]]:
    """Return round values from low to high in equal steps of 1, 2 or 5 times a power of ten, with their texts."""
    rough = (high - low) / _TICKS
    ten = 10.0 ** math.floor(math.log10(rough))
    step = next(factor * ten for factor in (1, 2, 5, 10) if factor * ten >= rough * (1 - 1e-9))
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    values = step * np.arange(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)
    # Zero has no sign.
    return [(float(value), f"{value + 0.0:.{decimals}f}") for value in values]


def _widen(low: float, high: float) -> tuple[float, float]:
    """Return a range with a margin; equal values get a range of 1."""
    margin = _MARGIN * (high - low) or 0.5
    return low - margin, high + margin


def _make_scale(low: float, high: float, first: float, last: float):
    def pixel(value):
        return first + (value - low) / (high - low) * (last - first)

    return pixel


def _draw_line(x: float, y: float, to_x: float, to_y: float, colour: str) -> str:
    return f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{to_x:.1f}" y2="{to_y:.1f}" stroke="{colour}"/>'


def _write(x: float, y: float, text: str, anchor: str) -> str:
    style = 'font-size="11" font-family="sans-serif" fill="#2b3440"'
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" {style}>{escape(text)}</text>'


_BINS = 60  # of the displayed histogram
_DEFAULT_RADIUS_MM, _DEFAULT_WIDTH_MM = 15.0, 2.0
_GROWING = "points of a running scan have no uncertainty: reconstruct it"
_WITHOUT = "the cloud has no uncertainty"
_LIVE_WITHOUT = "the calibration states no uncertainty"
AddButton = Callable[[str, Callable[[], object]], ui.button]
Tool = Literal["distance", "step"]


@dataclass
class Measuring:
    """State of measurements, shared by all browsers: the opened cloud, positions picked in it, and the list."""

    cloud: PointCloud | None = None
    picked: list[np.ndarray] = field(default_factory=list)
    values: MeasuredValues = field(default_factory=MeasuredValues)

    def open(self, cloud: PointCloud | None) -> None:
        """Measure another cloud, or that of the running scan; the list is kept."""
        self.cloud, self.picked = cloud, []


class MeasurePanel:
    """Tab in one browser; ``button`` adds a button whose errors are shown, ``mark`` marks places in the cloud."""

    def __init__(
        self,
        folder: Path,
        board: Board,
        measuring: Measuring,
        *,
        button: AddButton,
        mark: Callable[[Sequence[np.ndarray]], None],
    ):
        self._folder, self._board, self._measuring = folder, board, measuring
        self._button, self._mark = button, mark
        self._section: Section | None = None
        self._source, self._without, self._live = "", "", False
        self._places_mm: list[float] = []
        self._rows: dict[int, _Row] = {}
        self._shown: MeasuredValues | None = None
        self._tool: Tool = "distance"
        self._plot: Plot | None = None

    def build(self) -> None:
        """Build the tab."""
        ui.label("Click points in the cloud: the last two give a length, the last one the middle of a shape.").classes(
            "text-sm"
        )
        self._places = ui.label("no point is picked").classes("text-sm font-mono whitespace-pre-wrap")
        with ui.row().classes("gap-1"):
            self._button("length", self._add_length).props("dense")
            self._button("section", self._cut).props("outline dense")
            self._button("live profile", self._follow).props("outline dense")
            self._button("forget", self._forget).props("flat dense")
        with ui.element("div").classes("fields"):
            self._radius = NumberField("radius about the point, mm", value=_DEFAULT_RADIUS_MM, min=0.01)
            for shape in get_args(Shape):
                self._button(shape, partial(self._fit_shape, shape)).props("outline dense")
        with ui.element("div").classes("fields"):
            self._width = NumberField("width, mm", value=_DEFAULT_WIDTH_MM, min=0.001)
            self._field = ui.select(["Z", "intensity", "deviation"], value="Z", label="field")
            self._button("histogram", self._show_histogram).props("outline dense")
        # The content is made by `Plot.draw`, which escapes texts.
        self._image = ui.interactive_image(size=(_WIDTH, _HEIGHT), on_mouse=self._pick_along, sanitize=False)
        self._image.classes("plot w-full").props('role="img"').set_visibility(False)
        self._caption = ui.label().classes("text-sm font-mono")
        with ui.row().classes("gap-2") as self._in_section:
            for tool in get_args(Tool):
                self._button(tool, partial(self._choose_tool, tool)).props("outline dense")
            self._button("keep", self._keep).props("dense")
        self._in_section.set_visibility(False)
        self._list = ui.column().classes("w-full gap-1")
        with ui.column().classes("w-full gap-1") as self._ending:
            with ui.element("div").classes("fields"):
                self._name = ui.input("name of the results")
                self._replace = ui.checkbox("replace existing")
            with ui.row().classes("gap-2"):
                self._button("save the list", self._save)
                self._button("undo", self._undo).props("outline")
        self.refresh()

    def refresh(self) -> None:
        """Show changes of the list, and the latest profile."""
        if self._live and (latest := self._board.profile) is not None and latest.section is not self._section:
            self._section = latest.section
            self._show_section()
        values = self._measuring.values
        if values is not self._shown:
            self._shown = values
            self._show_values(values)

    # In the cloud

    def show_picked(self, place: np.ndarray) -> None:
        """Add a position that was clicked in the cloud."""
        picked = self._measuring.picked
        if picked and np.array_equal(picked[-1], place):
            return
        picked.append(place)
        del picked[:-2]
        self._mark(picked)
        self._places.set_text("\n".join(f"X {x:.3f}  Y {y:.3f}  Z {z:.3f} mm" for x, y, z in picked))

    def _forget(self) -> None:
        self._measuring.picked.clear()
        self._mark([])
        self._places.set_text("no point is picked")

    def _choose_cloud(self) -> tuple[PointCloud, str]:
        """Return the opened cloud, or else that of the running scan, and the reason why it has no uncertainty."""
        if (opened := self._measuring.cloud) is not None:
            return opened, _WITHOUT
        points = self._board.cloud.points()
        none = np.full(len(points), -1)
        return PointCloud(points[:, :3], points[:, 3], none, none, metadata={}), _GROWING

    def _require_two(self) -> list[np.ndarray]:
        if len(self._measuring.picked) < 2:
            raise DescriptionError("click two points in the cloud first")
        return self._measuring.picked

    def _add_length(self) -> None:
        (first, second), (cloud, without) = self._require_two(), self._choose_cloud()
        found = measure_length(cloud, find_nearest_point(cloud, first), find_nearest_point(cloud, second))
        self._add(found, self._board.cloud_name, without)

    async def _fit_shape(self, shape: Shape) -> None:
        picked, (cloud, without) = self._measuring.picked, self._choose_cloud()
        if not picked:
            raise DescriptionError("click a point in the cloud first")
        radius, source = _require_positive(self._radius, "the radius about the point"), self._board.cloud_name
        self._add(await asyncio.to_thread(fit_shape_near, cloud, picked[-1], radius, shape), source, without)

    def _add(self, found: PickedMeasurement, source: str, without: str) -> None:
        self._board.say(found.text())
        self._measuring.values = self._measuring.values.add(found, source=source, without_interval=without)

    # In a section or a profile

    def _cut(self) -> None:
        (first, second), (cloud, self._without) = self._require_two(), self._choose_cloud()
        self._section = cut_section(cloud, first, second, width_mm=_require_positive(self._width, "the width"))
        self._live, self._source = False, f"{self._board.cloud_name}, section"
        self._places_mm = sorted([0.0, float((second - first) @ self._section.direction)])
        self._show_section()

    def _follow(self) -> None:
        if self._board.profile is None:
            raise DescriptionError(
                "there is no profile yet: choose the calibration under Scan, then show live images with the laser, "
                "or record a scan"
            )
        self._live, self._section, self._places_mm, self._without = True, None, [], _LIVE_WITHOUT
        self.refresh()

    def _pick_along(self, event: MouseEventArguments) -> None:
        if self._section is not None and self._plot is not None:
            self._places_mm = [*self._places_mm, self._plot.place_of(event.image_x)][-2:]
            self._show_section()

    def _draw(self, plot: Plot) -> None:
        self._plot = plot
        self._image.set_visibility(True)
        self._image.props(f'aria-label="{escape(plot.up_label)} over {escape(plot.across_label)}"')
        self._image.set_content(plot.draw())

    def _choose_tool(self, tool: Tool) -> None:
        self._tool = tool
        self._show_section()

    def _measure_section(self) -> PickedMeasurement:
        if self._section is None or len(self._places_mm) < 2:
            raise DescriptionError("click two places in the plot")
        section, (first, second) = self._section, self._places_mm
        if self._tool == "distance":
            return measure_length(section.cloud, section.find_nearest(first), section.find_nearest(second))
        return measure_step(section, first, second, width_mm=_require_positive(self._width, "the width"))

    def _keep(self) -> None:
        self._add(self._measure_section(), self._source, self._without)

    def _show_section(self) -> None:
        section = self._section
        if section is None or len(section.cloud) == 0:
            return
        if self._live:
            self._source = f"profile at X {section.cloud.points_mm[0, 0]:.3f} mm"
        nearest = [section.find_nearest(place) for place in self._places_mm]
        along, depth = section.along_mm, section.depth_mm
        self._draw(
            Plot(
                along,
                depth,
                "Y / mm" if self._live else "along the section / mm",
                "Z / mm",
                downwards=True,
                marks=[(float(along[index]), float(depth[index])) for index in nearest],
            )
        )
        self._in_section.set_visibility(True)
        try:
            text = self._measure_section().text()
        except Error as error:
            text = str(error)
        self._caption.set_text(f"{self._source}: {text}")

    def _show_histogram(self) -> None:
        cloud, _ = self._choose_cloud()
        name = str(self._field.value)
        known = {"Z": cloud.points_mm[:, 2], "intensity": cloud.intensity, "deviation": cloud.deviation_mm}[name]
        values = np.empty(0) if known is None else known[np.isfinite(known)].astype(float)
        if len(values) == 0:
            raise DescriptionError(f"the cloud has no {name}: choose another field, or open a cloud that has it")
        counts, edges = np.histogram(values, _BINS)
        unit = "grey values" if name == "intensity" else "mm"
        width = float(edges[1] - edges[0])
        self._live, self._section = False, None
        self._in_section.set_visibility(False)
        self._draw(Plot(edges[:-1] + width / 2, counts, f"{name} / {unit}", "points", bar_width=width))
        self._caption.set_text(
            f"{name}: mean {values.mean():.4f}, standard deviation {values.std():.4f} {unit}, {len(values):,} points"
        )

    # List

    def _show_values(self, values: MeasuredValues) -> None:
        """Update the rows; rows that remain keep the focus."""
        known = {each.number for each in values.values}
        for number in [number for number in self._rows if number not in known]:
            self._rows.pop(number).element.delete()
        for place, value in enumerate(values.values):
            if value.number not in self._rows:
                with self._list:
                    self._rows[value.number] = _Row(value.number, self._measuring, self._button, self._board)
            self._rows[value.number].show(value, place)
        self._ending.set_visibility(bool(values.values) or values.before is not None)
        self._name.props["placeholder"] = self._suggest_name()
        self._name.update()

    def _suggest_name(self) -> str:
        return name_cloud(self._board.cloud_name or "profile")

    def _undo(self) -> None:
        self._measuring.values = self._measuring.values.undo()

    async def _save(self) -> None:
        name = (self._name.value or "").strip() or self._suggest_name()
        page = new_path(self._folder, f"{name}{MEASURED_ENDINGS[0]}", suffix=MEASURED_ENDINGS[0])
        values, overwrite = self._measuring.values, bool(self._replace.value)
        title = f"Measured values of {name}"

        def save() -> list[Path]:
            return write_measured(page, values, title=title, overwrite=overwrite)

        self._board.say(f"wrote {', '.join(each.name for each in await asyncio.to_thread(save))}")

    def open(self, name: str) -> None:
        """Read a list of the folder in place of the present one, which undo restores."""
        read = read_measured(find_file(self._folder, name))
        self._measuring.values = self._measuring.values.replace(read.values)
        self._board.say(f"{name}: {len(read.values)} values")


class _Row:
    """Row of the list in one browser."""

    def __init__(self, number: int, measuring: Measuring, button: AddButton, board: Board):
        self._number, self._measuring, self._board = number, measuring, board
        self._list = ui.context.slot.parent
        self._shown: MeasuredValue | None = None

        def renamed(values: MeasuredValues) -> MeasuredValues:
            return values.rename(number, str(self._name.value or ""))

        def limited(values: MeasuredValues) -> MeasuredValues:
            return values.limit(number, self._lower.value, self._upper.value)

        with ui.element("div").classes("measured") as self.element:
            self._name = ui.input("name").props("dense").on("change", lambda: self._change(renamed))
            self._lower = NumberField("lower, mm").props("dense").on("change", lambda: self._change(limited))
            self._upper = NumberField("upper, mm").props("dense").on("change", lambda: self._change(limited))
            self._text = ui.label().classes("value font-mono text-sm")
            self._verdict = ui.label().classes("verdict text-sm")
            button("remove", self._remove).props("flat dense")

    def show(self, value: MeasuredValue, place: int) -> None:
        """Show a value at a place of the list."""
        self._show_fields(value)
        self._text.set_text(value.interval_text())
        self._verdict.set_text(value.verdict)
        self._verdict.props(f'data-verdict="{value.verdict}"')
        if self._list.default_slot.children[place] is not self.element:
            self.element.move(target_index=place)

    def _show_fields(self, value: MeasuredValue, *, restore: bool = False) -> None:
        """Show name and limits; without ``restore`` only changed ones, because the user may be typing in the others."""
        before, self._shown = self._shown, value
        for element, name in ((self._name, "name"), (self._lower, "lower_mm"), (self._upper, "upper_mm")):
            wanted = getattr(value, name)
            if restore or before is None or wanted != getattr(before, name):
                element.value = wanted

    def _change(self, change: Callable[[MeasuredValues], MeasuredValues]) -> None:
        values = self._measuring.values
        try:
            self._measuring.values = change(values)
        except Error as error:
            # The list has not changed.
            self._show_fields(values.find(self._number), restore=True)
            self._board.say(str(error), "error")
            ui.notify(str(error), type="negative", multi_line=True)
        else:
            # At once: the next refresh may come after the user has typed on.
            self._show_fields(self._measuring.values.find(self._number))

    def _remove(self) -> None:
        self._measuring.values = self._measuring.values.remove(self._number)


def _require_positive(number: NumberField, called: str) -> float:
    value = float(number.value or 0.0)
    if value <= 0:
        raise DescriptionError(f"give {called}, above 0 mm")
    return value
