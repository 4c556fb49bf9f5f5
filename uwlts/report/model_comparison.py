"""Results of a model comparison: a file of figures, lines for a terminal, and a page."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

from markupsafe import Markup

from uwlts._version import __version__
from uwlts.calibration.model_comparison.comparison import (
    POINTS,
    STRIPES,
    Captures,
    Choice,
    Comparison,
    PolynomialScore,
    Score,
    ScoredModel,
    compare_models,
)
from uwlts.calibration.model_comparison.held_out import (
    DIMENSIONS,
    FEWEST_HELD,
    INSIDE,
    OUTSIDE,
    Candidate,
    describe_distortion,
)
from uwlts.files.inputs import protect_inputs
from uwlts.files.json_files import json_text
from uwlts.model.sensor import Description
from uwlts.pages.numbers import format_fixed, format_length
from uwlts.pages.toolkit import (
    MISSING,
    figure_svg,
    legend_below,
    new_figure,
    refuse_unsuitable_page,
    render_page,
    write_page,
)
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.stripe import StripeSettings

_WAYS = (INSIDE, OUTSIDE)


@dataclass(frozen=True)
class HeldOutScore(Score):
    """A score, with the model's additional error relative to the best, in quadrature, and its standard error.

    Both are None if the model is as good as the best.
    """

    adds_mm: float | None
    adds_std_mm: float | None


class ModelRow(Description):
    """The scores of a model, or the reason why it cannot be calibrated."""

    model: str
    parameters: int | None
    reason: str | None = None
    inside: HeldOutScore | None = None
    outside: HeldOutScore | None = None
    as_good: bool | None = None

    def score(self, where: str) -> HeldOutScore | None:
        """Return the score for images held out inside or outside the volume."""
        return self.inside if where == INSIDE else self.outside


class ModelComparisonContent(Description):
    """All figures of a comparison as stored in its file, lengths in mm."""

    format: Literal["uwlts-models"]
    version: Literal[1]
    sensor: str
    captures: list[str]
    software: str
    date: str
    held_out: dict[str, int]
    models: list[ModelRow]
    best: str
    simplest: str
    polynomials: PolynomialScore | None
    verdicts: list[str]
    warnings: list[str]


def make_content(comparison: Comparison) -> ModelComparisonContent:
    """Return all figures of a comparison."""
    choice, score, polynomials = comparison.choice, comparison.polynomials, comparison.why_none
    if score is not None:
        polynomials = (
            f"polynomials, fitted to the target in {score.medium} alone, have an error of "
            f"{format_length(score.all_mm)} ± {format_length(score.std_mm)} for stripes in {score.images} images "
            "inside the calibrated volume, the simplest model "
            f"{format_length(score.model_mm)} ± {format_length(score.model_std_mm)}; outside they do not measure"
        )
    return ModelComparisonContent(
        format="uwlts-models",
        version=1,
        sensor=comparison.sensor,
        captures=comparison.captures,
        software=f"uwlts {__version__}",
        date=datetime.now(UTC).isoformat(timespec="seconds"),
        held_out={where: len(held) for where, held in choice.splits.items()},
        models=[_row(choice, judged) for judged in choice.judged],
        best=choice.best().describe(),
        simplest=choice.simplest().describe(),
        polynomials=score,
        verdicts=[*verdicts(choice), polynomials],
        warnings=comparison.warnings,
    )


def _row(choice: Choice, judged: ScoredModel) -> ModelRow:
    row = ModelRow(model=judged.candidate.describe(), parameters=judged.parameters)
    if judged.reason:
        return row.model_copy(update={"reason": judged.reason})
    scores: dict[str, object] = {}
    for where, score in judged.scores.items():
        cost = compute_additional_error(choice, judged.candidate, choice.best(), where)
        scores[where] = HeldOutScore(**vars(score), adds_mm=cost and cost[0], adds_std_mm=cost and cost[1])
    return row.model_copy(update=scores | {"as_good": judged.candidate in choice.list_equivalent()})


def format_lines(content: ModelComparisonContent) -> list[str]:
    """Return the table and the verdicts as lines of text."""
    width = max(len(row.model) for row in content.models)
    heads = [f"{where} the volume, {content.held_out[where]} images held out" for where in _WAYS]
    columns = f"{'points':>8}{'stripes':>9}{'all':>15}{'adds':>14}"
    units = f"{'px':>8}{'px':>9}{'µm':>15}{'µm':>14}"
    lines = [
        f"{'':{width}} {'':>4}" + "".join(f"{head:>{len(columns)}}" for head in heads),
        f"{'model':{width}} {'free':>4}{columns}{columns}",
        f"{'':{width}} {'':>4}{units}{units}",
    ]
    for row in content.models:
        if row.inside is None or row.outside is None:
            lines.append(f"{row.model:{width}} no calibration: {row.reason}")
        else:
            lines.append(f"{row.model:{width}} {row.parameters:>4}{_cells(row.inside)}{_cells(row.outside)}")
    return [*lines, "", *content.verdicts]


def _cells(score: HeldOutScore) -> str:
    everything, cost = _in_um(score.all_mm, score.std_mm), "as good"
    if score.adds_mm is not None and score.adds_std_mm is not None:
        cost = _in_um(score.adds_mm, score.adds_std_mm)
    points, stripes = (format_fixed(score.px[kind], 4) if kind in score.px else MISSING for kind in (POINTS, STRIPES))
    return f"{points:>8}{stripes:>9}{everything:>15}{cost:>14}"


def _in_um(value_mm: float, std_mm: float) -> str:
    return f"{format_fixed(1e3 * value_mm, 1)} ± {format_fixed(1e3 * std_mm, 1)}"


@protect_inputs()
def write_models(
    *,
    air: Captures = (),
    water: Captures = (),
    step: Captures = (),
    target_poses: Literal["stage", "free"] = "stage",
    index: float | None = None,
    stripe: StripeSettings = None,
    workers: int | None = None,
    out: str | Path | None = None,
    overwrite: bool = False,
    progress: ProgressListener = ignore_progress,
) -> Comparison:
    """Compare sensor models by how well each predicts images that were not used for its calibration.

    The models differ in one property: one or two refractions, window tilt, bow of the sheet, turn of the laser's
    window, or lens distortion. Each model is calibrated without every fourth image, and without the nearest and
    farthest images.

    Parameters
    ----------
    air : sequence of Capture or path
        Captures of the target in air, as for uwlts calibrate.
    water : sequence of Capture or path
        Captures of the target in the medium of use.
    step : sequence of Capture or path
        Captures of the step standard in the medium of use.
    target_poses : {"stage", "free"}
        stage: one target pose per capture, moved by the stage. free: every image has its own pose.
    index : float, optional
        Refractive index of the medium relative to air. Default: the index that follows from the captures.
    stripe : StripeOptions or dict, optional
        Options for finding the stripe, all or some: see `uwlts.StripeOptions`.
    workers : int, optional
        Number of models calibrated in parallel. Default: number of processors.
    out : str or Path, optional
        Page to write, with the figures as JSON beside it. Default: none is written.
    overwrite : bool
        Replace existing files.
    progress : callable, optional
        Called with the number of images or models done, the total, and the name of the stage.

    Returns
    -------
    Comparison
        Models ranked by their errors in held-out images, the polynomials' errors, and warnings.

    Raises
    ------
    CalibrationError
        There are too few images, or they do not determine a calibration.
    DescriptionError
        There is no capture of a target, a capture does not describe its target or step standard, or ``workers`` is less
        than 1.
    CaptureError
        A file is missing or damaged.
    RangeError
        The refractive index is out of range.
    OutputError
        A file exists and ``overwrite`` is not given, or cannot be written.
    """
    if out is not None:
        refuse_unsuitable_page(Path(out), overwrite=overwrite)
    comparison = compare_models(
        air=air,
        water=water,
        step=step,
        target_poses=target_poses,
        index=index,
        stripe=stripe,
        workers=workers,
        progress=progress,
    )
    if out is not None:
        content = make_content(comparison)
        write_page(
            out, models_page(content), beside=json_text(content, indent=2, only_ascii=False), overwrite=overwrite
        )
    return comparison


def models_page(content: ModelComparisonContent) -> str:
    """Return the page as text."""
    return render_page("uwlts.report", "models.html.j2", c=content, ways=_WAYS, picture=_picture(content))


def _picture(content: ModelComparisonContent) -> Markup | None:
    """Plot the additional error of each model by its number in the table; None if there are none."""
    shown = {}
    for where in _WAYS:
        scores = [(number, row.score(where)) for number, row in enumerate(content.models, start=1)]
        adding = [(number, 1e3 * s.adds_mm, 1e3 * (s.adds_std_mm or 0)) for number, s in scores if s and s.adds_mm]
        if adding:
            shown[where] = adding
    if not shown:
        return None
    figure, panels = new_figure(5.6 * len(shown), 3.4, columns=len(shown))
    label = "additional error relative to the best, with standard error"
    # Both charts number all models, including those without additional error.
    count = len(content.models)
    for axes, (where, adding) in zip(panels, shown.items(), strict=True):
        number, adds_um, error_um = zip(*adding, strict=True)
        axes.errorbar(number, adds_um, error_um, fmt="o", capsize=2.5, label=label)
        axes.set(title=f"{where} the calibrated volume", xlabel="model", ylabel="adds / µm", yscale="log")
        axes.set(xlim=(0.5, count + 0.5), xticks=range(1, count + 1))
    legend_below(figure)
    return figure_svg(figure)


_PARTS = {
    "refractions": ("the glass plate", "with a single refraction"),
    "window_tilt": ("the tilt of the window", "without it"),
    "bow": ("the bow of the sheet", "without it"),
    "window_turn": ("the turn of the laser's window", "without it"),
}


_OF_THE_WINDOW = {"refractions", "window_tilt"}
"""Effects on rays in a medium that are negligible in air: only images in a medium show whether they are needed."""


def compute_additional_error(
    choice: Choice, candidate: Candidate, other: Candidate, where: str, *, wet: bool = False
) -> tuple[float, float] | None:
    """Return the additional error of a model relative to another, in quadrature, in mm, with its standard error.

    It is None if the model is as good. All images held out are used, or with ``wet`` only those in a medium.
    """
    tally = (choice.wet_tallies if wet else choice.tallies)[where]
    if choice.predicts_as_well(candidate, other, where, wet=wet):
        return None
    difference, std = tally.compute_excess(choice.number(candidate), choice.number(other))
    root = float(difference**0.5)
    return root, std / (2 * root)


def verdicts(choice: Choice) -> list[str]:
    """Return sentences on which modelled effects are needed, and which model to use."""
    usual, said = Candidate(), []
    known = {each.candidate: each for each in choice.judged}
    for name, (part, lacking) in _PARTS.items():
        without = known.get(replace(usual, **{name: DIMENSIONS[name][0]}))
        if without is None:
            continue
        by_window = name in _OF_THE_WINDOW
        loss = (
            f"there is no calibration, {without.reason}" if without.reason else _describe_costs(choice, without, usual)
        )
        if not loss and by_window and not choice.wet_tallies:
            said.append(
                f"whether {part} is needed is not shown: of the images held out {min(choice.wet.values())} are in "
                f"water, at least {FEWEST_HELD} inside and outside the calibrated volume are needed"
            )
            continue
        loss = loss or (_describe_costs(choice, without, usual, wet=True) if by_window else "")
        seen = f"{sum(choice.wet.values())} images held out in water" if by_window else "images held out"
        found = f"needed: {lacking} {loss}" if loss else f"not needed: {lacking} {seen} are predicted as well"
        said.append(f"{part} is {found}")
    return [*said, _describe_distortion(choice, list(known)), *_describe_choice(choice)]


def _describe_distortion(choice: Choice, candidates: Sequence[Candidate]) -> str:
    usual = Candidate()
    levels = [c.distortion for c in candidates if replace(c, distortion=usual.distortion) == usual]
    enough = choice.level("distortion", levels)
    said = f"{describe_distortion(enough)} is enough"
    least = replace(usual, distortion=enough)
    fewer = max((level for level in levels if len(level) < len(enough)), key=len, default=None)
    if fewer is not None:
        judged = next(each for each in choice.judged if each.candidate == replace(usual, distortion=fewer))
        said += f": with {describe_distortion(fewer)} {judged.reason or _describe_costs(choice, judged, least)}"
    return said


def _describe_costs(choice: Choice, without: ScoredModel, usual: Candidate, *, wet: bool = False) -> str:
    """Describe where a model is worse, and by how much; empty if it is as good."""
    found = {
        where: compute_additional_error(choice, without.candidate, usual, where, wet=wet) for where in without.scores
    }
    parts = [
        f"{format_length(cost[0])} ± {format_length(cost[1])} {'inside' if where == INSIDE else 'outside'}"
        for where, cost in found.items()
        if cost is not None
    ]
    where = " in water" if wet else ""
    return f"points{where} have an additional error of {' and '.join(parts)} the calibrated volume" if parts else ""


def _describe_choice(choice: Choice) -> list[str]:
    best, simplest, good = choice.best(), choice.simplest(), choice.list_equivalent()
    others = [candidate.describe() for candidate in good if candidate not in (best, simplest)]
    said = f"best prediction: {best.describe()}"
    if simplest != best:
        said += f"; simplest model that is as good within the standard errors: {simplest.describe()}"
    elif others:
        said += ", which is also the simplest of the equally good models"
    return [said + (f"; equally good: {'; '.join(others)}" if others else "")]
