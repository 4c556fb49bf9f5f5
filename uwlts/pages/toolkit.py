"""Templates, style, figures, numbers and files shared by all HTML pages.

A page is a Jinja template that extends ``base.html.j2`` and uses the macros of ``components.html.j2``::

    {% extends "base.html.j2" %}
    {% block title %}Measurement report{% endblock %}
    {% block content %}{{ tiles(key_figures) }} ... {{ chart(cloud) }}{% endblock %}

    figures = FigureCollector()
    text = render_page("uwlts.report", "campaign.html.j2", interactive=figures,
                       histogram=svg_of(static), cloud=figures.add(interactive, "All points."))
    write_page(path, text, overwrite=overwrite)

Pages contain all their content and load nothing from the network. This module computes nothing and imports nothing of
the measurement software, so that the twin can use it, too.
"""

from __future__ import annotations

import base64
import io
import math
import os
import re
import shutil
import subprocess
import sys
import tempfile
import warnings
from contextlib import ExitStack
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from jinja2 import Environment, FileSystemLoader
from markupsafe import Markup

from uwlts._version import __version__
from uwlts.errors import SetupError
from uwlts.files.writing import refuse_unsuitable, write_atomically
from uwlts.pages.cloud_figure import CloudPoints, view_scripts

if TYPE_CHECKING:
    import plotly.graph_objects as go
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

    Drawn = Figure | SubFigure | Axes

MISSING = "-"  # placeholder for a missing value in tables of text

INK, SOFT, FAINT, BLUE, RED = "#2b3440", "#5c6875", "#dde2e8", "#3573b1", "#b5303c"
"""Colours of text, notes, grid lines, and of the main and the contrasting line, as in ``style.css``."""

COLOURS = (BLUE, "#d9822b", "#2e8b57", RED, "#7b4fa3", "#5b6770", "#12a3a8", "#a0722a")
"""Colours of the lines of one figure, in order."""

_STYLE: dict[Any, Any] = {
    "axes.prop_cycle": f"cycler(color={list(COLOURS)})",
    "font.size": 9.0,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "axes.titlesize": 10.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": FAINT,
    "axes.spines.top": False,
    "axes.spines.right": False,
}
# Text remains text, and the same figure gives the same file.
_SVG: dict[Any, Any] = {"svg.fonttype": "none", "svg.hashsalt": "page"}


def render_page(package: str, template: str, /, *, interactive: FigureCollector | None = None, **values: Any) -> str:
    """Render the text of a page from a template and values.

    The ``package``'s folder, or its folder ``templates``, holds the template, which extends ``base.html.j2``. Scripts
    are embedded only if there are interactive figures. Every template knows the ``software`` and its version.
    """
    templates = Path(__file__).with_name("templates")
    folder = Path(str(files(package)))
    loader = FileSystemLoader([folder, folder / "templates", templates])
    environment = Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters["minus"] = typeset_number
    components = environment.get_template("components.html.j2").module
    environment.globals.update({name: part for name, part in vars(components).items() if not name.startswith("_")})
    collected = FigureCollector() if interactive is None else interactive
    scripts, clouds, plotly = collected.scripts, collected.clouds, ""
    if scripts:
        from plotly.offline import get_plotlyjs

        # The script must not contain the end tag of a script element.
        plotly = Markup(get_plotlyjs().replace("</script", "<\\/script"))
    return environment.get_template(template).render(
        page_style=Markup((templates / "style.css").read_text(encoding="utf-8")),
        page_figures=scripts,
        page_plotly=plotly,
        page_clouds=clouds,
        page_cloud_scripts=view_scripts() if clouds else {},
        software=f"uwlts {__version__}",
        **values,
    )


HTML = (".html", ".htm")  # file name endings of pages


def write_page(
    path: str | Path,
    text: str,
    *,
    beside: str | None = None,
    kind: str = "",
    pdf: bool = False,
    overwrite: bool = False,
) -> None:
    """Write a page, and optionally as PDF and a JSON text ``beside`` it (`json_beside`), each completely or not at all.

    Raises OutputError if a file exists and ``overwrite`` is not set, or cannot be written.
    """
    if pdf:
        refuse_unsuitable_page(Path(path), kind=kind, pdf=True, overwrite=overwrite)
        print_pdf(text, Path(path).with_suffix(".pdf"), overwrite=overwrite)
    with ExitStack() as stack:
        if beside is not None:
            aside = stack.enter_context(write_atomically(json_beside(Path(path), kind), overwrite=overwrite))
            aside.write_text(beside, encoding="utf-8")
        aside = stack.enter_context(write_atomically(path, overwrite=overwrite))
        # A file name on the page may contain bytes that are not text.
        aside.write_text(text, encoding="utf-8", errors="replace")


def json_beside(page: Path, kind: str = "") -> Path:
    """Return the path of a page's JSON: PAGE.json, or PAGE.KIND.json unless the page's name ends with the kind.

    Pages of findings and registrations are named after the object, like its other JSON files.
    """
    return page.with_suffix(".json" if page.stem.rpartition(".")[2] == kind or not kind else f".{kind}.json")


def refuse_unsuitable_page(page: Path, *, kind: str = "", pdf: bool = False, overwrite: bool) -> None:
    """Raise OutputError or SetupError if a page, its PDF, or the JSON beside it (`json_beside`) cannot be written."""
    if pdf:
        find_browser()
        refuse_unsuitable(page.with_suffix(".pdf"), overwrite=overwrite)
    refuse_unsuitable(page, overwrite=overwrite, endings=HTML)
    refuse_unsuitable(json_beside(page, kind), overwrite=overwrite)


@dataclass(frozen=True)
class InteractiveFigure:
    """Position of an interactive figure or cloud in a page; a figure has a height in px."""

    number: int
    caption: str
    height: int = 0


class FigureCollector:
    """Interactive figures and clouds of a page, each numbered, with their JSON for the end of the page."""

    def __init__(self) -> None:
        self.scripts: list[Markup] = []
        self.clouds: list[Markup] = []

    def add(self, figure: go.Figure, caption: str = "") -> InteractiveFigure:
        """Add a plotly figure with a height."""
        self.scripts.append(_encode_for_script(figure.to_json(validate=False) or ""))
        return InteractiveFigure(len(self.scripts) - 1, caption, int(figure.layout.height))

    def add_cloud(self, points: CloudPoints, caption: str) -> InteractiveFigure:
        """Add a cloud."""
        self.clouds.append(_encode_for_script(points.to_json()))
        return InteractiveFigure(len(self.clouds) - 1, caption)


def _encode_for_script(text: str) -> Markup:
    """Return JSON for a script element, where there is no escaping: the text must not contain its end tag."""
    return Markup(text.replace("<", "\\u003c"))


@dataclass(frozen=True)
class Tile:
    """A key figure of the ``tiles`` component: its name, its value, and lines of notes below."""

    name: str
    value: str
    note: str = ""
    accent: bool = False


def make_figure(
    width: float, height: float, *, layout: Literal["constrained"] | None = "constrained", shown: bool = False
) -> Figure:
    """Return an empty matplotlib figure of a size in inches; if ``shown``, `pyplot.show` and notebooks show it."""
    # Only programs that have imported pyplot, and notebooks, can show figures.
    if shown and {"matplotlib.pyplot", "ipykernel"} & sys.modules.keys():
        from matplotlib import pyplot

        return pyplot.figure(figsize=(width, height), layout=layout)
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout=layout)
    FigureCanvasAgg(figure)
    return figure


def new_figure(
    width: float = 5.6, height: float = 3.2, *, rows: int = 1, columns: int = 1, shown: bool = False
) -> tuple[Figure, list[Axes]]:
    """Return a matplotlib figure in the pages' style, of a size in inches, and its axes row by row.

    ``shown``: `pyplot.show` and notebooks show the figure.
    """
    import matplotlib

    figure = make_figure(width, height, shown=shown)
    with matplotlib.rc_context(_STYLE):
        return figure, list(figure.subplots(rows, columns, squeeze=False).flat)


def legend_below(figure: Figure, *, columns: int = 4) -> None:
    """Add one legend below all axes of a figure, with each label once."""
    handles = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    if handles:
        style = {"loc": "outside lower left", "fontsize": 9, "frameon": False, "labelcolor": INK}
        figure.legend(handles.values(), handles.keys(), ncols=columns, **style)


def figure_svg(drawn: Drawn) -> Markup:
    """Return a matplotlib figure, or the figure of axes, as an SVG element for a page."""
    text = _save_figure(drawn, format="svg", metadata={"Date": None}).decode("utf-8")
    # Paths are accurate to 0.01 pt.
    text = re.sub(r'(?<= d=")[^"]*', lambda path: re.sub(r"(\.\d\d)\d+", r"\1", path[0]), text)
    # Ids of groups would be repeated in every figure and are not referenced; SVG in HTML needs no namespaces.
    text = re.sub(r'(?<=<g) id="[^"]*"|<metadata>.*?</metadata>| xmlns(:\w+)?="[^"]*"', "", text, flags=re.S)
    return Markup(text[text.index("<svg") :].replace("xlink:href", "href"))


def figure_png(drawn: Drawn, *, dpi: int = 100, few_colours: bool = False) -> bytes:
    """Return a matplotlib figure, or the figure of axes, as PNG; ``few_colours`` are 256, for a third of the size."""
    # The name and version of the software would change the file.
    data = _save_figure(drawn, format="png", dpi=dpi, metadata={"Software": None})
    if not few_colours:
        return data
    from PIL import Image

    smaller = io.BytesIO()
    # Pillow's octree method takes a fifth of the time of the others.
    reduced = Image.open(io.BytesIO(data)).convert("RGB")
    reduced.quantize(256, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(smaller, "png")
    return smaller.getvalue()


def _save_figure(drawn: Drawn, **options: Any) -> bytes:
    import matplotlib
    from matplotlib.figure import Figure

    figure = drawn
    while not isinstance(figure, Figure):
        figure = figure.figure
    data = io.BytesIO()
    with matplotlib.rc_context(_SVG), warnings.catch_warnings():
        # The font may lack characters in names of files; browsers have other fonts.
        warnings.filterwarnings("ignore", "Glyph .* missing")
        figure.savefig(data, **options)
    if "matplotlib.pyplot" in sys.modules:
        # Figures of pages are not shown beside them.
        sys.modules["matplotlib.pyplot"].close(figure)
    return data.getvalue()


def plain_text(text: str) -> str:
    """Escape a text so that matplotlib finds no formulas in it."""
    return text.replace("$", r"\$")


def png_data_uri(picture: Drawn | bytes, *, dpi: int = 100) -> str:
    """Return a matplotlib figure, or the bytes of a PNG, as an address that contains the whole picture."""
    data = picture if isinstance(picture, bytes) else figure_png(picture, dpi=dpi)
    return "data:image/png;base64," + base64.b64encode(data).decode("ascii")


def typeset_number(text: str) -> str:
    """Replace a minus sign of a number by the typographic one, and a missing value by a dash."""
    if text == MISSING:
        return "\N{EN DASH}"
    return "\N{MINUS SIGN}" + text[1:] if text.startswith("-") else text


BROWSERS = ("chromium", "chromium-headless-shell", "google-chrome", "google-chrome-stable", "msedge")
"""Names of browsers on PATH; the environment variable CHROMIUM names another one."""

_PATIENCE_S = 120.0  # time limit: a page with a few pictures takes 2 s, or much longer on a slow machine


def print_pdf(page: str, path: Path, *, overwrite: bool = False) -> None:
    """Print the text of a page as PDF, completely or not at all.

    Raises SetupError if there is no Chromium, Chrome or Edge, or it does not print; OutputError if the file exists or
    cannot be written.
    """
    browser = find_browser()
    with write_atomically(path, overwrite=overwrite) as aside, tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "page.html"
        source.write_text(page, encoding="utf-8", errors="replace")
        # The page is the program's own and loads nothing; root cannot use the sandbox.
        flags = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={folder}/profile"]
        flags += ["--no-pdf-header-footer", f"--print-to-pdf={aside.absolute()}", source.as_uri()]
        try:
            done = subprocess.run([browser, *flags], capture_output=True, text=True, timeout=_PATIENCE_S, check=False)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise SetupError(f"{browser} cannot print {path.name}: {error}") from error
        if not aside.stat().st_size:
            message = " ".join(done.stderr.split())[-300:]
            raise SetupError(f"{browser} has not printed {path.name} (exit status {done.returncode}): {message}")


def find_browser() -> str:
    """Return the path of the browser that prints; raises SetupError without a browser."""
    if chosen := os.environ.get("CHROMIUM"):
        if found := shutil.which(chosen):
            return found
        raise SetupError(f"the environment variable CHROMIUM names {chosen}, which is not a program")
    for name in BROWSERS:
        if found := shutil.which(name):
            return found
    raise SetupError(
        "a PDF needs Chromium, Chrome or Edge, and none is on PATH: install one (Debian: apt-get install chromium), "
        "let the environment variable CHROMIUM name one, or print the page from a browser"
    )


def format_fixed(value: float | None, decimals: int = 3, *, signed: bool = False) -> str:
    """Format a number with fixed decimals; a number that rounds to zero has no sign."""
    if value is None or not math.isfinite(value):
        return MISSING
    text = f"{value:{'+' if signed else ''}.{decimals}f}"
    return text if float(text) else text.lstrip("+-")


def format_to_scale(value: float, scale: float) -> str:
    """Format a number with as many decimals as a scale with two significant digits has."""
    return format_fixed(value, max(0, 1 - math.floor(math.log10(scale))) if scale > 0 else 3)
