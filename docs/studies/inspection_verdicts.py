"""Verdicts of inspections of damaged pipes and parts like them, for 20 seeds a kind (tests/oracles).

    python -m docs.studies.inspection_verdicts --write
    python -m docs.studies.inspection_verdicts --kinds gouges --first 0 --each

Each depth is judged with limits of 0.9 and 1.1 times its true value. Thresholds are chosen on seeds 0 to 19: judge them
on seeds that were not looked at.
"""

from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor

import numpy as np
from cyclopts import App

import uwlts
from docs.studies.result_tables import publish, table
from tests.oracles import damaged_pipes, joined_pipes
from tests.oracles.damaged_pipes import Part, Truth
from uwlts.errors import EvaluationError
from uwlts.inspection.features import Feature, FeatureKind, Inspection
from uwlts.inspection.findings_order import FindingLimits, judge_feature
from uwlts.storage.cloud import PointCloud

KINDS = damaged_pipes.KINDS | joined_pipes.KINDS
LIMITS = 0.9, 1.1
"""Limits divided by the true depth."""
JUDGED = FeatureKind.PIT, FeatureKind.DENT, FeatureKind.PROTRUSION, FeatureKind.WELD
HEAD = ["kind", "truths", "sized", "not mentioned, or false verdict", "within 95 % interval", "invented"]
HEAD += ["refused or named"]


def inspect(part: Part) -> Inspection:
    """Inspect a part as a pipe."""
    cloud = PointCloud(part.points_mm, np.ones(len(part.points_mm)), part.frame, part.line)
    return uwlts.inspect_pipe(cloud, **part.options)


def count_verdicts(part: Part) -> Counter[str]:
    """Return the counts of a part by the names in the table."""
    counts = Counter[str](truths=len(part.truths))
    try:
        found = inspect(part)
    except EvaluationError as error:
        right = any(name in str(error) for name in part.names)
        return counts + Counter({"refused" if right else "refused without reason": 1})
    if any(name in note for name in part.names for note in found.notes):
        counts["refused"] += 1
    features = found.select(*JUDGED)
    places = np.array([each.place_mm for each in features]).reshape(-1, 3)
    taken = np.zeros(len(features), bool)
    for truth in part.truths:
        own = np.flatnonzero(truth.covers(places) & ~taken) if len(features) else np.zeros(0, int)
        if not len(own):
            counts["not mentioned"] += 1
            continue
        # Features are in the order of their depths.
        taken[own[0]] = True
        counts += count_values(features[own[0]], truth)
    counts["invented"] += int(np.count_nonzero(~taken))
    return counts


def count_values(feature: Feature, truth: Truth) -> Counter[str]:
    """Return the counts of one finding of something that is there."""
    bounded = feature.reason is not None
    counts = Counter({"bounded" if bounded else "sized": 1})
    for name, true in truth.values.items():
        if name not in feature:
            continue
        value = feature[name]
        inside = value.low <= true <= value.high
        counts["wrong bound"] += int(bounded and not inside)
        counts["values"] += int(not bounded)
        counts["inside"] += int(not bounded and inside)
    if (true := truth.values.get("depth")) is not None:
        for share in LIMITS:
            verdict = judge_feature(feature, FindingLimits(depth_mm=share * true))[0]
            counts["false within"] += int(verdict == "within the limit" and share < 1)
            counts["false exceeds"] += int(verdict == "exceeds the limit" and share > 1)
    return counts


def count_drawn(kind: str, seed: int) -> Counter[str]:
    """Return the counts of the part of a kind with a seed."""
    return count_verdicts(KINDS[kind](np.random.default_rng([seed, list(KINDS).index(kind)])))


def row(kind: str, counts: Counter[str]) -> list[str]:
    """Return a row of the table."""
    bounds = f" ({counts['wrong bound']} bounds wrong)" if counts["wrong bound"] else ""
    refused = f"{counts['refused']}"
    if counts["refused without reason"]:
        refused += f" ({counts['refused without reason']} without reason)"
    wrong = counts["not mentioned"] + counts["false within"] + counts["false exceeds"]
    return [
        kind,
        f"{counts['truths']}",
        f"{counts['sized']}{bounds}",
        f"{wrong}",
        f"{counts['inside']} of {counts['values']}" if counts["values"] else "",
        f"{counts['invented']}",
        refused,
    ]


def main(
    *, kinds: Sequence[str] = (), first: int = 400, parts: int = 20, workers: int = 1, each: bool = False,
    write: bool = False,
) -> None:  # fmt: skip
    """Print or write the table.

    Parameters
    ----------
    kinds
        Kinds of parts; all by default.
    first
        First seed.
    parts
        Number of parts of each kind, with one seed after the other.
    workers
        Processes that inspect parts.
    each
        Also print the counts of each part.
    write
        Write the table into the page of results.
    """
    rows, total, seeds = [], Counter[str](), range(first, first + parts)
    with ProcessPoolExecutor(workers) as pool:
        for kind in kinds or KINDS:
            summed = Counter[str]()
            for seed, counts in zip(seeds, pool.map(count_drawn, [kind] * parts, seeds), strict=True):
                if each:
                    print(kind, seed, {key: number for key, number in counts.items() if number}, flush=True)
                summed += counts
            total += summed
            rows.append(row(kind, summed))
            print("\t".join(rows[-1]), flush=True)
    publish({"verdicts of inspections": table(HEAD, [*rows, row("all", total)])}, write=write)


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
