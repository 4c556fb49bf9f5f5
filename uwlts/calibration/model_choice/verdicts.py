"""What the comparison says, in words."""

from collections.abc import Sequence
from dataclasses import replace

from uwlts.calibration.model_choice.candidates import DIMENSIONS, Candidate, distortion_words
from uwlts.calibration.model_choice.choice import Choice, Judged
from uwlts.calibration.model_choice.held_out import INSIDE
from uwlts.report.numbers import small_length

_PARTS = {
    "refractions": ("the glass plate", "with a single refraction"),
    "window_tilt": ("the tilt of the window", "without it"),
    "bow": ("the bow of the sheet", "without it"),
    "window_turn": ("the turn of the laser's window", "without it"),
}


def adds(choice: Choice, candidate: Candidate, other: Candidate, where: str) -> tuple[float, float] | None:
    """What a model misses besides another, in quadrature, in mm with its standard error; None where it is as good."""
    tally = choice.tallies[where]
    if choice.no_worse(candidate, other, where):
        return None
    difference, std = tally.beyond(choice.number(candidate), choice.number(other))
    root = float(difference**0.5)
    return root, std / (2 * root)


def verdicts(choice: Choice) -> list[str]:
    """For everything that was modelled in several ways what is needed, and which model to take."""
    usual, said = Candidate(), []
    known = {each.candidate: each for each in choice.judged}
    for name, (part, lacking) in _PARTS.items():
        without = known.get(replace(usual, **{name: DIMENSIONS[name][0]}))
        if without is None:
            continue
        if without.reason:
            said.append(f"{part} is needed: {lacking} there is no calibration, {without.reason}")
        elif costs := _costs(choice, without, usual):
            said.append(f"{part} is needed: {lacking} {costs}")
        else:
            said.append(f"{part} is not needed: {lacking} images held out are predicted as well")
    return [*said, _of_distortion(choice, list(known)), *_chosen(choice)]


def _of_distortion(choice: Choice, candidates: Sequence[Candidate]) -> str:
    usual = Candidate()
    levels = [c.distortion for c in candidates if replace(c, distortion=usual.distortion) == usual]
    enough = choice.level("distortion", levels)
    said = f"{distortion_words(enough)} is enough"
    least = replace(usual, distortion=enough)
    fewer = max((level for level in levels if len(level) < len(enough)), key=len, default=None)
    if fewer is not None:
        judged = next(each for each in choice.judged if each.candidate == replace(usual, distortion=fewer))
        said += f": with {distortion_words(fewer)} {judged.reason or _costs(choice, judged, least)}"
    return said


def _costs(choice: Choice, without: Judged, usual: Candidate) -> str:
    """Where and by how much a model is worse; nothing where it is as good."""
    found = {where: adds(choice, without.candidate, usual, where) for where in without.scores}
    parts = [
        f"{small_length(cost[0])} ± {small_length(cost[1])} {'inside' if where == INSIDE else 'outside'}"
        for where, cost in found.items() if cost is not None
    ]  # fmt: skip
    return f"points are missed by a further {' and '.join(parts)} the calibrated volume" if parts else ""


def _chosen(choice: Choice) -> list[str]:
    best, simplest, good = choice.best(), choice.simplest(), choice.as_good()
    others = [candidate.words() for candidate in good if candidate not in (best, simplest)]
    said = f"best predicts: {best.words()}"
    if simplest != best:
        said += f"; the simplest that is as good within the standard errors: {simplest.words()}"
    elif others:
        said += ", which is also the simplest of those as good"
    return [said + (f"; as good are also: {'; '.join(others)}" if others else "")]
