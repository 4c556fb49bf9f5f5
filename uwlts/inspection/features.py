"""Features of an inspected object: values with uncertainty, place in the cloud, and definitions."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path

import numpy as np

from uwlts.argument_types import check_arguments
from uwlts.files.json_files import write_record
from uwlts.model.sensor import Table
from uwlts.model.short_text import Brief
from uwlts.storage.cloud import PointCloud, rounding_std_mm

COVERAGE = 0.95
"""Coverage probability of the intervals of all values."""
COVERAGE_FACTOR = 1.96
"""Standard normal quantile of (1 + COVERAGE) / 2."""
BIAS_STD = 1.0 / math.sqrt(3.0)
"""Standard uncertainty of a corrected bias, as a fraction of the bias. The bias of simulated shapes and noise is known,
that of the real shape lies between none and twice as much: rectangular distribution (GUM, 4.3.7)."""
SEED = 635
"""Seed of all noise draws, so that equal clouds give equal values."""
WITHOUT_UNCERTAINTY = "the cloud does not contain uncertainties: intervals contain the scatter of its points only"
"""Note on an inspection of such a cloud."""


class FeatureKind(StrEnum):
    """Kind of a feature. A section is a cross-section of a pipe."""

    PIPE = "pipe"
    SECTION = "section"
    PIT = "pit"
    DENT = "dent"
    PROTRUSION = "protrusion"
    WELD = "weld"


BLEMISHES = (FeatureKind.PIT, FeatureKind.DENT, FeatureKind.PROTRUSION)
"""Kinds of flaws, listed by their severity."""


@dataclass(frozen=True)
class Definition:
    """Definition of a value: unit, text, and the document that defines it or the quantity that it serves."""

    unit: str
    text: str
    source: str


_GAUSSIAN = "ISO 14405-1 (GG), least squares"
_OUT_OF_ROUND = "DNV-ST-F101, out of roundness"
_UNDERCUT = "ISO 5817, 5011"
_B31G = "ASME B31G"
_BLEMISH = {
    "depth": Definition("mm", "greatest depth below the undamaged surface, interpolated from around it", _B31G + ", d"),
    "total depth": Definition("mm", "depth in a dent below the form of the undamaged pipe", "this project"),
    "edge depth": Definition("mm", "depth of the contour that bounds length, width and area", "this project"),
    "length": Definition("mm", "extent of the contour along the pipe's axis", _B31G + ", L"),
    "width": Definition("mm", "extent of the contour along the circumference", "POF 100, width"),
    "area": Definition("mm2", "area within the contour, on the surface", "this project"),
    "lost area": Definition(
        "mm2",
        "area of metal lost in the axial plane: at each place along the axis the greatest depth, summed",
        _B31G + " (river-bottom profile), A",
    ),
    "remaining wall": Definition("mm", "wall thickness given less the depth", _B31G + ", t - d"),
}

DEFINITIONS: dict[FeatureKind, dict[str, Definition]] = {
    FeatureKind.PIPE: {
        "diameter": Definition("mm", "mean diameter of the sections", _GAUSSIAN),
        "ovality": Definition("mm", "largest less smallest diameter of the elliptic part", _OUT_OF_ROUND),
        "ovality share": Definition("%", "ovality over the diameter", "DNV-ST-F101, f0"),
        "straightness": Definition(
            "mm", "largest distance of two sections' centres across their line, by the axis's bow", "ISO 12780-1, STRt"
        ),
        "axis place 1": Definition("mm", "place of the axis along the feature's first axis", _GAUSSIAN),
        "axis place 2": Definition("mm", "place of the axis along the feature's second axis", _GAUSSIAN),
        "axis slope 1": Definition("deg", "angle from the stated axis towards the feature's first axis", _GAUSSIAN),
        "axis slope 2": Definition("deg", "angle from the stated axis towards the feature's second axis", _GAUSSIAN),
    },
    FeatureKind.SECTION: {
        "diameter": Definition("mm", "mean diameter of the section", _GAUSSIAN),
        "ovality": Definition("mm", "largest less smallest diameter of the elliptic part", _OUT_OF_ROUND),
        "ovality angle": Definition("deg", "direction of the largest diameter, from the first axis", "this project"),
    },
    FeatureKind.PIT: _BLEMISH,
    FeatureKind.DENT: _BLEMISH,
    FeatureKind.PROTRUSION: {
        "height": Definition("mm", "greatest height above the surface around it", "this project"),
        **{name: _BLEMISH[name] for name in ("edge depth", "length", "width", "area")},
    },
    FeatureKind.WELD: {
        "height": Definition(
            "mm", "greatest height above the line between both plates, mean of the sections", "ISO 5817, 502"
        ),
        "largest height": Definition(
            "mm", "the same in the three neighbouring sections that are highest", "ISO 5817, 502"
        ),
        "width": Definition("mm", "distance of the toes, median of the sections", "ISO 5817, 502, b"),
        "undercut left": Definition("mm", "depth of the groove at the left toe, mean along the weld", _UNDERCUT),
        "undercut right": Definition("mm", "depth of the groove at the right toe, mean along the weld", _UNDERCUT),
        "largest undercut": Definition(
            "mm", "mean depth of the groove in the five neighbouring sections that are deepest", "ISO 5817, 5012"
        ),
        "toe angle left": Definition(
            "deg", "180 deg less the slope of the flank from 10 to 50 % height, median", "ISO 5817, 505"
        ),
        "toe angle right": Definition("deg", "the same at the right toe", "ISO 5817, 505"),
        "misalignment": Definition("mm", "offset of the plates in the middle of the weld", "ISO 5817, 507"),
    },
}
"""Definitions of all values by kind of feature and name."""


@dataclass(frozen=True)
class FeatureValue:
    """Value of a feature, in its definition's unit.

    Attributes
    ----------
    name, unit : str
    value : float
    random : float
        Standard uncertainty by the noise of points and stage positions.
    systematic : float or None
        Standard uncertainty by errors common to all points; None if the cloud does not contain such errors.
    low, high : float
        Ends of the 95 % coverage interval; never below zero for values that cannot be negative. A bound has an
        infinite other end.
    """

    name: str
    value: float
    unit: str
    random: float
    systematic: float | None
    low: float
    high: float

    @property
    def uncertainty(self) -> float:
        """Combined standard uncertainty of the known parts."""
        return float(np.hypot(self.random, self.systematic or 0.0))

    def widen(self, *, random: float = 0.0, systematic: float = 0.0) -> FeatureValue:
        """Return the value with further independent standard uncertainties, and a wider interval."""
        more = COVERAGE_FACTOR * np.hypot(random, systematic)
        low, high = (
            self.value - np.hypot(self.value - self.low, more),
            self.value + np.hypot(self.high - self.value, more),
        )
        low = max(low, 0.0) if self.low >= 0 else low
        common = float(np.hypot(self.systematic or 0.0, systematic)) if systematic else self.systematic
        return replace(
            self, random=float(np.hypot(self.random, random)), systematic=common, low=float(low), high=float(high)
        )

    def as_bound(self) -> FeatureValue:
        """Return the value as a bound: at least its lower end, or for a remaining wall at most its upper end."""
        return replace(self, low=-math.inf) if self.name == "remaining wall" else replace(self, high=math.inf)

    @property
    def bound(self) -> tuple[str, float] | None:
        """Words and the number of a bound; None for a value with two ends."""
        if math.isinf(self.high):
            return "at least", self.low
        return ("at most", self.high) if math.isinf(self.low) else None

    def text(self) -> str:
        """Return name, value and interval as text."""
        if self.bound:
            return f"{self.name} {self.bound[0]} {self.bound[1]:.4g} {self.unit}"
        return f"{self.name} {self.value:.4g} ({self.low:.4g} to {self.high:.4g}) {self.unit}"


@dataclass(frozen=True, eq=False)
class Feature:
    """Feature found in a cloud.

    Attributes
    ----------
    kind : FeatureKind
    name : str
        Unique in its inspection, such as "pit 3".
    values : tuple of FeatureValue
        Values by the names in ``DEFINITIONS[kind]``.
    place_mm : (3,) float64
        Middle in the cloud's frame; for a pit the deepest place.
    axes : (3, 3) float64
        Unit vectors in rows, in the cloud's frame: along the feature's length, its width, and outwards. For a pipe and
        a section: two directions across the axis, then the axis.
    extent_mm : (3,) float64
        Size along these directions.
    points : (K,) int
        Indices of its points in the cloud.
    false_alarm : float or None
        Probability that noise gives an indication of this significance anywhere on the inspected area; None for
        features that need no detection.
    outline_mm : (K, 3) float64
        Closed contour of a blemish at its edge depth, in the cloud's frame; empty for other features.
    hollows_mm : (H, 3) float64
        Deepest (or highest) places of neighbours that the search joined, in the cloud's frame; empty for a single one.
    reason : str or None
        Why its values are bounds only; None if it is seen whole and sized.
    """

    kind: FeatureKind
    name: str
    values: tuple[FeatureValue, ...]
    place_mm: np.ndarray
    axes: np.ndarray
    extent_mm: np.ndarray
    points: np.ndarray
    false_alarm: float | None = None
    outline_mm: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    hollows_mm: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    reason: str | None = None

    @property
    def title(self) -> str:
        """Name with the number of joined neighbours, such as "pit 1 (2 joined)"."""
        return f"{self.name} ({len(self.hollows_mm)} joined)" if len(self.hollows_mm) else self.name

    def __getitem__(self, name: str) -> FeatureValue:
        """Return the value of a name; raise KeyError if it does not exist."""
        for value in self.values:
            if value.name == name:
                return value
        raise KeyError(f"{self.name} does not have {name}; it has {', '.join(value.name for value in self.values)}")

    def __contains__(self, name: str) -> bool:
        return any(value.name == name for value in self.values)

    def record(self) -> Table:
        """Return the feature as JSON, with its number of points."""
        defined = DEFINITIONS[self.kind]
        return {
            "kind": str(self.kind),
            "name": self.name,
            "values": {
                v.name: {
                    "value": v.value,
                    "unit": v.unit,
                    "random": v.random,
                    "systematic": v.systematic,
                    "low": v.low if math.isfinite(v.low) else None,
                    "high": v.high if math.isfinite(v.high) else None,
                    "definition": defined[v.name].text,
                    "source": defined[v.name].source,
                }
                for v in self.values
            },
            "place_mm": self.place_mm.tolist(),
            "axes": self.axes.tolist(),
            "extent_mm": self.extent_mm.tolist(),
            "points": len(self.points),
            "false_alarm": self.false_alarm,
            "outline_mm": np.round(self.outline_mm, 3).tolist(),
            "hollows_mm": np.round(self.hollows_mm, 3).tolist(),
            "reason": self.reason,
        }


@dataclass(frozen=True, eq=False, repr=False)
class Inspection(Brief):
    """Result of an inspection.

    Attributes
    ----------
    kind : str
        Kind of object: "pipe" or "weld".
    features : tuple of Feature
        The whole object first, then its parts.
    deviation_mm : (N,) float64
        Distance of each point of the cloud, without repeated ones, from the undamaged surface, positive outwards; NaN
        for omitted points.
    notes : tuple of str
        Limitations of the result.
    """

    kind: str
    features: tuple[Feature, ...]
    deviation_mm: np.ndarray
    notes: tuple[str, ...] = ()

    def consider_cloud(self, cloud: PointCloud) -> Inspection:
        """Return the inspection with the cloud's warnings as notes, and its steps in the uncertainties of lengths."""
        self = replace(self, notes=(*self.notes, *cloud.warnings))
        if not (std := rounding_std_mm(cloud)):
            return self
        features = tuple(
            replace(each, values=tuple(v.widen(systematic=std) if v.unit == "mm" else v for v in each.values))
            for each in self.features
        )
        note = f"uncertainties contain {std:.2g} mm for the steps of the cloud's stored coordinates"
        return replace(self, features=features, notes=(*self.notes, note))

    def select(self, *kinds: FeatureKind) -> tuple[Feature, ...]:
        """Return the features of the given kinds."""
        return tuple(feature for feature in self.features if feature.kind in kinds)

    @check_arguments
    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write the record as indented JSON, completely or not at all; raises OutputError if that fails."""
        write_record(path, self.record(), overwrite=overwrite)

    def record(self) -> Table:
        """Return features and notes as JSON."""
        return {
            "kind": self.kind,
            "coverage": COVERAGE,
            "features": [feature.record() for feature in self.features],
            "notes": list(self.notes),
        }

    def lines(self) -> list[str]:
        """Return the inspection as text, one line per feature."""
        lines = [
            f"{each.title:15} {', '.join(value.text() for value in each.values)}"
            + (f"; {each.reason}" if each.reason else "")
            for each in self.features
        ]
        return [*lines, *(f"note: {note}" for note in self.notes)]


def plain_value(
    kind: FeatureKind, name: str, value: float, random: float, systematic: float | None, *, least: float = -np.inf
) -> FeatureValue:
    """Return a value with a symmetric interval, cut off at the least possible value.

    Standard uncertainties are in the unit of the value; the systematic one is None if unknown.
    """
    half = COVERAGE_FACTOR * float(np.hypot(random, systematic or 0.0))
    low, high = max(value - half, least), max(value + half, least)
    unit = DEFINITIONS[kind][name].unit
    common = None if systematic is None else float(systematic)
    return FeatureValue(name, float(value), unit, float(random), common, float(low), float(high))


def linear_value(
    kind: FeatureKind, name: str, value: float, covariances: tuple[np.ndarray, np.ndarray | None], by: np.ndarray
) -> FeatureValue:
    """Return a value with derivatives ``by`` (K,) by parameters, from their covariances (K, K) by `PointErrors`."""
    random, common = (None if each is None else float(np.sqrt(by @ each @ by)) for each in covariances)
    return plain_value(kind, name, value, random or 0.0, common)


def amplitude_value(
    kind: FeatureKind, name: str, vector: np.ndarray, random: np.ndarray, systematic: np.ndarray | None, *, scale: float
) -> FeatureValue:
    """Return the length of a vector (2,), times a scale.

    Noise increases the squared length of a vector by the trace of its covariance, which is subtracted (Rice, Bell
    System Technical Journal 24, 1945, section 3.10). The interval reaches zero if the vector is not significant.

    ``random`` and ``systematic`` (2, 2) are its covariances; the systematic one is None if unknown.
    """
    total = random if systematic is None else random + systematic
    length = float(np.linalg.norm(vector))
    corrected = float(np.sqrt(max(length**2 - float(np.trace(total)), 0.0)))
    along = vector / length if length > 0 else np.array([1.0, 0.0])

    def std(covariance: np.ndarray) -> float:
        # The direction of a vector near zero is random: use the largest variance.
        near = float(np.linalg.eigvalsh(covariance)[-1])
        far = float(along @ covariance @ along)
        share = min(length**2 / max(float(np.trace(total)), 1e-300) / 9, 1.0)
        return float(np.sqrt(max(share * far + (1 - share) * near, 0.0)))

    by_noise, by_common = std(random), None if systematic is None else std(systematic)
    half = COVERAGE_FACTOR * float(np.hypot(by_noise, by_common or 0.0))
    ends = max(corrected - half, 0.0), max(length, corrected) + half
    common = None if by_common is None else scale * by_common
    unit = DEFINITIONS[kind][name].unit
    return FeatureValue(name, scale * corrected, unit, scale * by_noise, common, scale * ends[0], scale * ends[1])
