"""Gauge study: repeatability and reproducibility of a figure over repeated scans of several parts."""

from __future__ import annotations

import csv
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy.stats import f as f_distribution, t as t_distribution

from uwlts.errors import DescriptionError, EvaluationError
from uwlts.files.json_files import RecordFile
from uwlts.files.reading import read_bytes
from uwlts.model.brief import Brief
from uwlts.model.sensor import Table

_MOST_BYTES = 64 * 2**20  # a million measured values
_POOLED_ABOVE = 0.25
"""p-value of the interaction above which it is pooled with the repeatability (AIAG)."""
_DRAWS = 20_000
"""Number of draws of the mean squares; 500 of them exceed each end of a 95 % interval."""
_SEED = 7
"""Seed of the draws, so that a study always has the same intervals."""
_SIGMAS = 6.0
"""Process width in standard deviations, as in %P/T (AIAG, Measurement Systems Analysis, 4th ed., ch. III-B)."""
_DISTINCT = 1.41
"""Factor of the number of distinct categories (AIAG)."""
_NEEDED_CG = 1.33
"""Least Cg and Cgk of a capable gauge (VDA 5; ISO 22514-7 defines the quantities)."""


@dataclass(frozen=True)
class Component:
    """Standard deviation of a source of variation, its 95 % interval, and its percentage of the total."""

    std: float
    low: float
    high: float
    share_percent: float
    tolerance_percent: float | None


@dataclass(frozen=True)
class Variance:
    """Row of the analysis of variance, with F and its p-value if tested."""

    source: str
    degrees: int
    sum_of_squares: float
    mean_square: float
    f: float | None
    probability: float | None


@dataclass(frozen=True, repr=False)
class GaugeStudy(Brief, RecordFile):
    """Crossed study: each operator measures each part equally often.

    The names in ``components`` are repeatability (EV), reproducibility (AV, including the interaction), gauge (GRR),
    parts (PV) and total (TV). ``distinct`` is the number of distinct categories, 1.41 PV / GRR.
    """

    parts: int
    operators: int
    repeats: int
    variances: tuple[Variance, ...]
    interaction_pooled: bool
    components: dict[str, Component]
    distinct: int
    tolerance: float | None

    def record(self) -> Table:
        """Return the study as JSON."""
        return asdict(self)

    def lines(self) -> list[str]:
        """Return the study as text."""
        lines = [f"{self.parts} parts, {self.operators} operators, {self.repeats} repeats"]
        lines += ["source                    degrees  mean square        F  probability"]
        for row in self.variances:
            tested = "" if row.f is None else f" {row.f:8.3f}     {row.probability:8.4f}"
            lines.append(f"  {row.source:24}{row.degrees:7d}  {row.mean_square:11.5g}{tested}")
        if self.interaction_pooled:
            lines.append("  the interaction is not significant: pooled with the repeatability")
        for name, each in self.components.items():
            of = "" if each.tolerance_percent is None else f", {each.tolerance_percent:.1f} % of the tolerance (6 std)"
            interval = f"({each.low:.5g} to {each.high:.5g})"
            lines.append(f"{name:26}std {each.std:.5g} {interval}, {each.share_percent:.1f} % of the total{of}")
        return [*lines, f"distinct categories       {self.distinct}"]


@dataclass(frozen=True, repr=False)
class RepeatedReference(Brief, RecordFile):
    """Repeated measurements of one part of known size (type-1 study).

    ``bias`` is the mean minus the reference; it is significant if its 95 % interval excludes 0. For a tolerance T and a
    standard deviation s, Cg = 0.2 T / (6 s) and Cgk = (0.1 T - abs(bias)) / (3 s).
    """

    count: int
    mean: float
    std: float
    bias: float
    bias_half_interval: float
    cg: float | None
    cgk: float | None

    def record(self) -> Table:
        """Return the study as JSON."""
        return asdict(self)

    def lines(self) -> list[str]:
        """Return the study as text."""
        said = "significant" if abs(self.bias) > self.bias_half_interval else "not significant"
        lines = [
            f"{self.count} repeats               mean {self.mean:.6g}, std {self.std:.4g}",
            f"bias                      {self.bias:+.5g} ± {self.bias_half_interval:.3g} (95 %), {said}",
        ]
        if self.cg is not None and self.cgk is not None:
            verdict = "capable" if min(self.cg, self.cgk) >= _NEEDED_CG else "not capable"
            lines.append(f"Cg, Cgk                   {self.cg:.3f}, {self.cgk:.3f}: {verdict} ({_NEEDED_CG} is needed)")
        return lines


def gauge_study(
    table: str | os.PathLike[str] | Sequence[tuple[str, str, float]],
    *,
    tolerance: float | None = None,
    true_value: float | None = None,
) -> GaugeStudy | RepeatedReference:
    """Evaluate a gauge from repeated measurements: repeatability, reproducibility and percentage of a tolerance.

    In a crossed study, each operator measures each part equally often. It is evaluated by analysis of variance with
    random effects (AIAG, Measurement Systems Analysis, 4th ed., chapter III-B and appendix A). An interaction with a
    p-value above 0.25 is pooled with the repeatability. The 95 % intervals are generalised confidence intervals (Hamada
    and Weerahandi, J. Quality Technology 32, 2000). With ``true_value``, repeated measurements of one part form a
    type-1 study.

    Parameters
    ----------
    table
        CSV file with the columns part, operator and value, one measurement per line; or a sequence of (part, operator,
        value). With ``true_value``, the column value suffices.
    tolerance
        Width of the tolerance, in the unit of the values.
    true_value
        True value of the only part, for a type-1 study with Cg and Cgk.

    Returns
    -------
    GaugeStudy or RepeatedReference
        Components of variance; with ``true_value`` the bias and the indices Cg and Cgk.

    Raises
    ------
    DescriptionError
        The file is not such a table, or a number is not finite.
    EvaluationError
        There are too few parts, operators or repeats, or combinations are missing.
    """
    if tolerance is not None and not 0 < tolerance < np.inf:
        raise EvaluationError(f"the tolerance is {tolerance:g}; expected a positive width")
    rows = (
        _read_table(Path(table))
        if isinstance(table, str | os.PathLike)
        else [(str(p), str(o), float(v)) for p, o, v in table]
    )
    if not np.isfinite([value for *_, value in rows]).all():
        raise DescriptionError("the table contains values that are not finite; remove or correct these lines")
    if true_value is not None:
        return _evaluate_repeats(rows, true_value, tolerance)
    return _evaluate_crossed(rows, tolerance)


def _read_table(path: Path) -> list[tuple[str, str, float]]:
    content = read_bytes(path, most_bytes=_MOST_BYTES, error=DescriptionError, called="table")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DescriptionError(f"{path} is not a text file: {error}") from error
    lines = text.splitlines()
    mark = next((each for each in (";", "\t", ",") if each in lines[0]), ",") if lines else ","
    try:
        return _read_rows(csv.DictReader(lines, delimiter=mark), path, decimal_comma=mark == ";")
    except csv.Error as error:
        raise DescriptionError(f"{path} is no CSV table: {error}") from error


def _read_rows(reader: csv.DictReader[str], path: Path, *, decimal_comma: bool) -> list[tuple[str, str, float]]:
    names = {name.strip().lower(): name for name in reader.fieldnames or () if name}
    if "value" not in names:
        raise DescriptionError(
            f"{path} has the columns {', '.join(names) or 'none'}; expected part, operator and value"
        )
    rows = []
    for number, row in enumerate(reader, start=2):
        written = (row[names["value"]] or "").strip()
        try:
            value = float(written.replace(",", ".") if decimal_comma else written)
        except ValueError as error:
            raise DescriptionError(f"{path}, line {number}: found '{written}', expected a number") from error
        part, operator = ((row[names[key]] or "").strip() if key in names else "" for key in ("part", "operator"))
        rows.append((part, operator, value))
    return rows


def _evaluate_repeats(
    rows: Sequence[tuple[str, str, float]], reference: float, tolerance: float | None
) -> RepeatedReference:
    if len({part for part, *_ in rows}) > 1:
        raise EvaluationError("`true_value` is the size of one part, but the table contains several parts")
    if len(rows) < 10:
        raise EvaluationError(f"found {len(rows)} measurements; a type-1 study needs at least 10, usually 50")
    values = np.array([value for *_, value in rows])
    mean, std = float(values.mean()), float(values.std(ddof=1))
    half = float(t_distribution.ppf(0.975, len(values) - 1)) * std / np.sqrt(len(values))
    if tolerance is not None and std == 0:
        raise EvaluationError("all values are equal: the figure may be rounded")
    cg = None if tolerance is None else 0.2 * tolerance / (6 * std)
    cgk = None if tolerance is None else (0.1 * tolerance - abs(mean - reference)) / (3 * std)
    return RepeatedReference(len(values), mean, std, mean - reference, float(half), cg, cgk)


def _evaluate_crossed(rows: Sequence[tuple[str, str, float]], tolerance: float | None) -> GaugeStudy:
    values = _arrange_values(rows)
    a, b, n = values.shape
    mean, of_part, of_operator, of_both = (
        values.mean(),
        values.mean(axis=(1, 2)),
        values.mean(axis=(0, 2)),
        values.mean(axis=2),
    )
    both = of_both - of_part[:, None] - of_operator + mean
    squares = {
        "parts": b * n * np.sum((of_part - mean) ** 2),
        "operators": a * n * np.sum((of_operator - mean) ** 2),
        "parts x operators": n * np.sum(both**2),
        "repeats": np.sum((values - of_both[:, :, None]) ** 2),
    }
    degrees = {"parts": a - 1, "operators": b - 1, "parts x operators": (a - 1) * (b - 1), "repeats": a * b * (n - 1)}
    if squares["repeats"] == 0:
        raise EvaluationError("all repeats are equal: the figure may be rounded, or one scan repeated in the table")
    ms = {name: squares[name] / degrees[name] for name in squares}

    def tested(name: str, against: str) -> tuple[float, float]:
        ratio = ms[name] / ms[against]
        return float(ratio), float(f_distribution.sf(ratio, degrees[name], degrees[against]))

    interaction = tested("parts x operators", "repeats")
    pooled = interaction[1] > _POOLED_ABOVE
    if pooled:
        joint = degrees["parts x operators"] + degrees["repeats"]
        error = (squares["parts x operators"] + squares["repeats"]) / joint
        used, counts = (ms["parts"], ms["operators"], error, error), (a - 1, b - 1, joint, joint)
    else:
        used, counts = tuple(ms.values()), tuple(degrees.values())
    estimate = _variance_components(np.array(used)[:, None], (a, b, n), pooled)
    # A mean square is its expectation times chi-square divided by its degrees of freedom. Dividing by draws of the
    # latter gives the distribution of the expectation.
    rng = np.random.default_rng(_SEED)
    chi = [rng.chisquare(count, _DRAWS) / count for count in counts]
    if pooled:
        chi[3] = chi[2]
    drawn = _variance_components(np.array([m / c for m, c in zip(used, chi, strict=True)]), (a, b, n), pooled)
    total = float(estimate["total (TV)"][0])
    components = {}
    for name, value in estimate.items():
        low, high = np.quantile(drawn[name], [0.025, 0.975])
        std = float(value[0])
        of = None if tolerance is None else 100 * _SIGMAS * std / tolerance
        components[name] = Component(std, float(low), float(high), 100 * std / total, of)
    against = "repeats" if pooled else "parts x operators"
    tests = {"parts": tested("parts", against), "operators": tested("operators", against)}
    tests["parts x operators"] = interaction
    variances = tuple(
        Variance(name, degrees[name], float(squares[name]), float(ms[name]), *tests.get(name, (None, None)))
        for name in squares
    )
    gauge = components["gauge (GRR)"].std
    distinct = int(_DISTINCT * components["parts (PV)"].std / gauge) if gauge > 0 else 0
    return GaugeStudy(a, b, n, variances, pooled, components, max(distinct, 1), tolerance)


def _variance_components(ms: np.ndarray, sizes: tuple[int, int, int], pooled: bool) -> dict[str, np.ndarray]:
    """Return standard deviations (K,) from mean squares (4, K) of parts, operators, interaction and repeats."""
    (a, b, n), (parts, operators, both, repeats) = sizes, ms
    interaction = np.zeros_like(repeats) if pooled else np.maximum((both - repeats) / n, 0)
    against = repeats if pooled else both
    reproducible = np.maximum((operators - against) / (a * n), 0) + interaction
    of_parts = np.maximum((parts - against) / (b * n), 0)
    gauge = repeats + reproducible
    variances = {"repeatability (EV)": repeats, "reproducibility (AV)": reproducible, "gauge (GRR)": gauge}
    variances |= {"parts (PV)": of_parts, "total (TV)": gauge + of_parts}
    return {name: np.sqrt(value) for name, value in variances.items()}


def _arrange_values(rows: Sequence[tuple[str, str, float]]) -> np.ndarray:
    """Arrange values as (parts, operators, repeats); EvaluationError if combinations are missing."""
    found: dict[tuple[str, str], list[float]] = {}
    for part, operator, value in rows:
        found.setdefault((part, operator), []).append(value)
    parts, operators = (list(dict.fromkeys(pair[k] for pair in found)) for k in (0, 1))
    for name, count, least in (("parts", len(parts), 2), ("operators", len(operators), 2)):
        if count < least:
            raise EvaluationError(
                f"the table has {count} {name}; a crossed study needs at least {least}, usually 10 and 3"
            )
    counts = {pair: len(found.get(pair, ())) for pair in ((p, o) for p in parts for o in operators)}
    repeats = max(counts.values())
    if short := [f"part {p}, operator {o}: {n}" for (p, o), n in counts.items() if n != repeats]:
        raise EvaluationError(
            f"expected {repeats} measurements of each part by each operator; found {'; '.join(short[:5])}"
        )
    if repeats < 2:
        raise EvaluationError("each operator measured each part once; a study needs repeats, usually 3")
    return np.array([[found[part, operator] for operator in operators] for part in parts])
