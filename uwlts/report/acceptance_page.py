"""Page of an acceptance test: verdict, characteristics with decisions, requirements, pictures, and traceability."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from markupsafe import Markup

from uwlts.acceptance.accept import FORMAT, VERSION, Acceptance, JudgedPosition
from uwlts.acceptance.acceptance_plan import SYMBOLS, CertifiedArtefact, Symbol
from uwlts.acceptance.characteristics import NAMES, RULES, Characteristic
from uwlts.files.json_files import json_text
from uwlts.model.artefacts import SphereStandard, StepStandard
from uwlts.pages.toolkit import (
    BLUE,
    COLOURS,
    INK,
    MISSING,
    RED,
    SOFT,
    figure_svg,
    format_fixed,
    legend_below,
    new_figure,
    plain_text,
    refuse_unsuitable_page,
    render_page,
    write_page,
)

KIND = "acceptance"  # kind of the page, in the name of its JSON file
_DECISIONS = {"conformity proven": "good", "accepted": "good", "nonconformity proven": "bad", "rejected": "bad"}
"""Kinds of decisions; all others are open."""
_COLOURS = {"good": "#2e8b57", "bad": RED, "open": "#d9822b"}
_SIGNED = ("PS", "SD", "E")


def write_acceptance(path: str | Path, acceptance: Acceptance, *, pdf: bool = False, overwrite: bool = False) -> None:
    """Write the page of an acceptance test, its result as sealed JSON beside it, and optionally a PDF.

    Parameters
    ----------
    path : str or Path
        Page to write; the JSON is written beside it, for test.html to test.acceptance.json.
    acceptance : Acceptance
        Result of `uwlts.accept`.
    pdf : bool
        Also print the page to a PDF beside it, with an installed Chromium or Chrome.
    overwrite : bool
        Replace existing files.

    Raises
    ------
    OutputError
        A file exists and ``overwrite`` is not given, or cannot be written.
    SetupError
        A PDF is requested, but no browser is installed.
    """
    page = Path(path)
    refuse_unsuitable_page(page, kind=KIND, pdf=pdf, overwrite=overwrite)
    text = acceptance_page(acceptance)
    content = {"format": FORMAT, "version": VERSION} | acceptance.model_dump(mode="json")
    write_page(page, text, beside=json_text(content, indent=2), kind=KIND, pdf=pdf, overwrite=overwrite)


def acceptance_page(acceptance: Acceptance) -> str:
    """Return the page as text."""
    plan = acceptance.plan
    measured: list[Symbol] = [
        symbol for symbol in SYMBOLS if any(value.symbol == symbol for value in acceptance.values)
    ]
    return render_page(
        "uwlts.report",
        "acceptance.html.j2",
        title=plan.title,
        conclusion=f"{acceptance.conclusion[0].upper()}{acceptance.conclusion[1:]}.",
        colour=_DECISIONS.get(acceptance.verdict, "open"),
        acceptance=acceptance,
        rule=RULES[plan.decision_rule],
        characteristics=[_make_characteristic_row(each) for each in acceptance.characteristics],
        limits=_draw_limits(acceptance) if acceptance.values else None,
        places=_draw_places(acceptance) if acceptance.values else None,
        lengths=_draw_lengths(acceptance) if any(value.length_mm for value in acceptance.values) else None,
        positions=[_position_row(number, each, measured) for number, each in enumerate(acceptance.positions, start=1)],
        measured=measured,
        artefacts=[_make_artefact_row(name, each) for name, each in plan.artefacts.items()],
    )


def _make_characteristic_row(each: Characteristic) -> tuple[str, ...]:
    text, guideline = NAMES[each.symbol]
    worst = each.worst
    value = MISSING if worst is None else format_fixed(worst.value_mm, 4, signed=each.symbol in _SIGNED)
    expanded = MISSING if worst is None or worst.expanded_mm is None else format_fixed(worst.expanded_mm, 4)
    place = MISSING if worst is None else f"{worst.position}, {worst.label}"
    limit, chance = each.limit_text() or MISSING, each.probability_text() or MISSING
    name = f"{text}; {guideline}"
    return each.symbol, each.decision_text(), value, expanded, limit, chance, place, f"{each.count}", name


def _position_row(number: int, each: JudgedPosition, measured: Sequence[Symbol]) -> tuple[str, ...]:
    """Return a position with the values of the measured characteristics."""
    state = f"{each.state}: {each.reason}" if each.reason else each.state
    values = []
    for symbol in measured:
        matching = [value.value_mm for value in each.values if value.symbol == symbol]
        shown = [format_fixed(value, 4, signed=symbol in _SIGNED).replace("-", "\N{MINUS SIGN}") for value in matching]
        values.append(" / ".join(shown) or MISSING)
    points = f"{each.on_artefact:,} of {each.points:,}; {each.rejected}" if each.points else MISSING
    return f"{number}", each.name, each.artefact, state, points, *values


def _make_artefact_row(name: str, each: CertifiedArtefact) -> tuple[str, ...]:
    standard = each.standard
    sizes = MISSING
    if isinstance(standard, SphereStandard):
        diameters = ", ".join(f"{diameter:g}" for diameter in standard.diameters_mm)
        sizes = f"diameters {diameters} ± {_format_stated(standard.diameter_uncertainty_mm)}"
        if standard.spacings_mm:
            spacings = ", ".join(f"{s:g}" for s in standard.spacings_mm)
            sizes += f"; spacings {spacings} ± {_format_stated(standard.spacing_uncertainty_mm)}"
    elif isinstance(standard, StepStandard):
        sizes = f"height {standard.height_mm:g} ± {_format_stated(standard.height_uncertainty_mm)}"
    form = MISSING if each.stated_form_mm() is None else f"{each.stated_form_mm():g} ± {each.form_uncertainty_mm:g}"
    expansion = "not stated"
    if each.expansion_per_k is not None:
        expansion = f"{1e6 * each.expansion_per_k:g} ± {1e6 * each.expansion_uncertainty_per_k:g}"
    return name, each.certificate or "not stated", sizes, form, f"{each.alignment_uncertainty_mm:g}", expansion


def _format_stated(value: float | None) -> str:
    return "not stated" if value is None else f"{value:g}"


def _draw_limits(acceptance: Acceptance) -> Markup:
    """Draw the values of each characteristic relative to its limit, the worst one with its interval."""
    limited = [each for each in acceptance.characteristics if each.mpe_mm is not None]
    figure, (axes,) = new_figure(9.0, 0.8 + 0.42 * max(len(limited), 1))
    for row, each in enumerate(reversed(limited)):
        matching = [value for value in acceptance.values if value.symbol == each.symbol]
        shares = [abs(value.value_mm) / (each.limit_mm(value) or 1.0) for value in matching]
        axes.plot(shares, [row] * len(shares), "o", markersize=3, color=SOFT, alpha=0.6)
        if each.worst is not None:
            colour = _COLOURS[_DECISIONS.get(each.decision, "open")]
            limit = each.limit_mm(each.worst) or 1.0
            half, middle = (each.worst.expanded_mm or 0.0) / limit, abs(each.worst.value_mm) / limit
            axes.errorbar(middle, row, xerr=half, fmt="o", color=colour, markersize=7, capsize=4, linewidth=2)
    axes.axvline(1.0, color=RED, linewidth=1.5)
    axes.set_yticks(range(len(limited)), [each.symbol for each in reversed(limited)])
    axes.set(xlabel="absolute value / maximum permissible error", ylim=(-0.6, len(limited) - 0.4))
    axes.set_xlim(left=0, right=max(1.15, axes.get_xlim()[1]))
    return figure_svg(figure)


def _draw_places(acceptance: Acceptance) -> Markup:
    """Draw where the artefacts were measured, seen along Y and along X; lengths are lines."""
    figure, panels = new_figure(9.0, 3.8, columns=2)
    names = list(acceptance.plan.artefacts)
    artefact_of = {each.name: each.artefact for each in acceptance.positions}
    for axes, across, label in ((panels[0], 0, "X / mm, along the stage"), (panels[1], 1, "Y / mm, along the stripe")):
        for value in acceptance.values:
            colour = COLOURS[names.index(artefact_of[value.position]) % len(COLOURS)]
            place = np.array(value.place_mm)
            if value.length_mm is not None and value.direction is not None:
                half = value.length_mm / 2 * np.array(value.direction)
                ends = np.array([place - half, place + half])
                name = plain_text(f"{artefact_of[value.position]} (length)")
                axes.plot(ends[:, across], ends[:, 2], "-", color=colour, linewidth=1.6, label=name)
            elif value.symbol in ("PF", "F"):
                name = plain_text(artefact_of[value.position])
                axes.plot(place[across], place[2], "os"[value.symbol == "F"], color=colour, markersize=6, label=name)
        axes.set(xlabel=label, ylabel="Z / mm, away from the sensor", aspect="equal")
        axes.invert_yaxis()
    legend_below(figure)
    return figure_svg(figure)


def _draw_lengths(acceptance: Acceptance) -> Markup:
    """Draw the error of each length with its test value uncertainty and limit."""
    lengths = [value for value in acceptance.values if value.length_mm is not None]
    figure, (axes,) = new_figure(9.0, 3.6)
    judged, labels = {each.symbol: each for each in acceptance.characteristics}, []
    for place, value in enumerate(lengths):
        along = "XYZ"[int(np.argmax(np.abs(value.direction)))] if value.direction else ""
        size = f"{value.symbol}, {value.length_mm or 0.0:.0f} mm, mostly along {along}"
        labels.append(plain_text(f"{value.position} ({size})"))
        axes.errorbar(
            place, 1e3 * value.value_mm, yerr=1e3 * (value.expanded_mm or 0.0), fmt="o", color=BLUE, capsize=4
        )
        if value.symbol in judged and (limit := judged[value.symbol].limit_mm(value)) is not None:
            for sign in (-1, 1):
                axes.plot([place - 0.35, place + 0.35], [sign * 1e3 * limit] * 2, color=RED, linewidth=1.5)
    axes.axhline(0, color=INK, linewidth=0.8)
    axes.set_xticks(range(len(lengths)), labels, fontsize=8, rotation=30, ha="right")
    axes.set_ylabel("error / µm")
    return figure_svg(figure)
