"""Plot of a section or a histogram in the page, with axes; a click gives the place along the horizontal axis."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from nicegui import ui
from nicegui.events import MouseEventArguments

_WIDTH, _HEIGHT = 360, 220
_LEFT, _RIGHT, _TOP, _BOTTOM = 52, 10, 10, 36
"""Size of the plot and of its margins, px."""
_TICKS = 5
"""Wanted number of ticks of an axis."""
_MOST_POINTS = 3000
"""Points that are drawn; more would overlap."""
_MARGIN = 0.05
"""Margin around the points as a fraction of their range."""


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

    @property
    def up_range(self) -> tuple[float, float]:
        """Range of the vertical axis, which begins at zero for bars."""
        if self.bar_width is not None:
            return 0.0, max(1.0, (1 + _MARGIN) * float(self.up.max()))
        return _widen(float(self.up.min()), float(self.up.max()))

    def place_of(self, pixel: float) -> float:
        """Return the horizontal coordinate of a pixel column."""
        low, high = self.across_range
        return low + (pixel - _LEFT) / (_WIDTH - _LEFT - _RIGHT) * (high - low)

    def draw(self) -> str:
        """Return the plot as the content of an SVG element of 360 x 220 px."""
        x = _scale(*self.across_range, _LEFT, _WIDTH - _RIGHT)
        ends = (_TOP, _HEIGHT - _BOTTOM) if self.downwards else (_HEIGHT - _BOTTOM, _TOP)
        y = _scale(*self.up_range, *ends)
        parts = [f'<rect width="{_WIDTH}" height="{_HEIGHT}" fill="white"/>']
        for value, text in ticks(*self.across_range):
            at = x(value)
            parts.append(_line(at, _TOP, at, _HEIGHT - _BOTTOM, "#dde2e8"))
            parts.append(_text(at, _HEIGHT - _BOTTOM + 13, text, "middle"))
        for value, text in ticks(*self.up_range):
            at = y(value)
            parts.append(_line(_LEFT, at, _WIDTH - _RIGHT, at, "#dde2e8"))
            parts.append(_text(_LEFT - 4, at + 4, text, "end"))
        parts.append(_text((_LEFT + _WIDTH - _RIGHT) / 2, _HEIGHT - 6, self.across_label, "middle"))
        middle = (_TOP + _HEIGHT - _BOTTOM) / 2
        parts.append(f'<g transform="rotate(-90 11 {middle:.1f})">{_text(11, middle, self.up_label, "middle")}</g>')
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
            parts.append(_line(x(across), _TOP, x(across), _HEIGHT - _BOTTOM, "#b5303c"))
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


def _scale(low: float, high: float, first: float, last: float):
    def pixel(value):
        return first + (value - low) / (high - low) * (last - first)

    return pixel


def _line(x: float, y: float, to_x: float, to_y: float, colour: str) -> str:
    return f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{to_x:.1f}" y2="{to_y:.1f}" stroke="{colour}"/>'


def _text(x: float, y: float, text: str, anchor: str) -> str:
    style = 'font-size="11" font-family="sans-serif" fill="#2b3440"'
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" {style}>{escape(text)}</text>'


class PlotView:
    """Plot in one browser; ``picked`` is called with the horizontal coordinate of a click."""

    def __init__(self, picked: Callable[[float], None]):
        self._picked = picked
        self._plot: Plot | None = None
        # The content is made by `Plot.draw`, which escapes texts.
        self._image = ui.interactive_image(size=(_WIDTH, _HEIGHT), on_mouse=self._click, sanitize=False)
        self._image.classes("plot w-full").props('role="img"')
        self._image.set_visibility(False)

    def show(self, plot: Plot | None) -> None:
        """Show a plot, or nothing."""
        self._plot = plot
        self._image.set_visibility(plot is not None)
        if plot is not None:
            self._image.props(f'aria-label="{escape(plot.up_label)} over {escape(plot.across_label)}"')
            self._image.set_content(plot.draw())

    def _click(self, event: MouseEventArguments) -> None:
        if self._plot is not None:
            self._picked(self._plot.place_of(event.image_x))
