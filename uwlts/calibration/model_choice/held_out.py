"""Which images are held out, and the evidence without them or of them alone."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from uwlts.calibration.joint.estimate import Evidence
from uwlts.calibration.joint.observations import StepProfileEvidence, TargetEvidence
from uwlts.calibration.joint.parameters import View
from uwlts.calibration.joint.procedure import JointProblem
from uwlts.calibration.target_placement import Placement
from uwlts.errors import CalibrationError

INSIDE, OUTSIDE = "inside", "outside"
Image = tuple[int, int]
"""Number of the piece of evidence, and of the image in it."""

_EVERY = 4
_OUTER = 1 / 6
_FEWEST_KEPT, _FEWEST_HELD = 4, 4


@dataclass(frozen=True)
class Split:
    """Images held out: inside the volume of the others, or outside of it, the nearest and the farthest."""

    where: str
    held: frozenset[Image]


def splits(problem: JointProblem) -> list[Split]:
    """Both ways of holding out. An image's depth is where its stripe lies in the image, among those seen alike.

    Every fourth image is held out, or those in the outer sixths of where stripes lie. Images without a stripe are not.

    Raises
    ------
    CalibrationError
        There are too few images.
    """
    inside: set[Image] = set()
    outside: set[Image] = set()
    for found in _by_depth(problem).values():
        images, places = [image for _, image in found], np.array([place for place, _ in found])
        inside |= set(images[1:-1:_EVERY])
        reach = _OUTER * (places[-1] - places[0])
        outer = (places < places[0] + reach) | (places > places[-1] - reach)
        if np.count_nonzero(~outer) >= _FEWEST_KEPT:
            outside |= {image for image, out in zip(images, outer, strict=True) if out}
    for held in (inside, outside):
        if len(held) < _FEWEST_HELD:
            raise CalibrationError(
                f"the captures have too few images with a stripe to hold some out: {len(held)} could be, at least "
                f"{_FEWEST_HELD} are needed; take 16 or more of the target at different depths"
            )
    return [Split(INSIDE, frozenset(inside)), Split(OUTSIDE, frozenset(outside))]


def _by_depth(problem: JointProblem) -> dict[View, list[tuple[float, Image]]]:
    """Images that show a stripe, by what they were seen through, in the order of where it lies across its lines."""
    found: dict[View, list[tuple[float, Image]]] = {}
    for number, piece in enumerate(problem.evidence):
        if isinstance(piece, TargetEvidence):
            places = {
                int(image): piece.stripe_pixels[piece.stripe_image == image, piece.across]
                for image in np.unique(piece.stripe_image)
            }
        elif isinstance(piece, StepProfileEvidence):
            places = {piece.image: piece.pixels[:, piece.across]}
        else:
            continue
        found.setdefault(piece.view, []).extend((float(np.median(at)), (number, i)) for i, at in places.items())
    return {view: sorted(images) for view, images in found.items()}


def without(problem: JointProblem, held: frozenset[Image]) -> tuple[JointProblem, list[int]]:
    """The problem without the images held out, and which pieces of its evidence are left."""
    evidence: list[Evidence] = []
    own, numbers = [], []
    for number, (piece, start) in enumerate(zip(problem.evidence, problem.own, strict=True)):
        if not isinstance(piece, TargetEvidence):
            if (number, piece.image) in held:
                continue
        else:
            kept = [image for image in np.unique(piece.placement.image).tolist() if (number, image) not in held]
            if not kept:
                continue
            piece = of_images(piece, kept)
            if piece.staged:
                start = np.concatenate([start[:8], np.zeros(len(piece.images()))])
        evidence.append(piece)
        own.append(start)
        numbers.append(number)
    return replace(problem, evidence=evidence, own=own), numbers


def of_images(evidence: TargetEvidence, images: Iterable[int]) -> TargetEvidence:
    """The evidence of some of the images; stage positions still count from the first of all."""
    placement, wanted = evidence.placement, list(images)
    here, lit = np.isin(placement.image, wanted), np.isin(evidence.stripe_image, wanted)
    return replace(
        evidence,
        placement=Placement(
            placement.points_mm[here], placement.shifts_mm[here], placement.pixels[here], placement.image[here],
            placement.along_z,
        ),
        stripe_pixels=evidence.stripe_pixels[lit], stripe_image=evidence.stripe_image[lit],
        stripe_shifts_mm=evidence.stripe_shifts_mm[lit],
    )  # fmt: skip
