"""The circle target in an image: numbered from its three marked circles."""

import numpy as np

from uwlts.errors import TargetError
from uwlts.targets.circles import find_circles, mark_strength
from uwlts.targets.description import CircleTarget
from uwlts.targets.lattice import label_lattice
from uwlts.targets.view import TargetView

# Above the median of all circles, which is below zero where blur lowers the ring of a small circle. A sharp dot has the
# strength 1, dirt and noise rarely more than 0.1; a dot of two pixels under blur keeps 0.4.
MIN_MARK_STRENGTH = 0.3

# Circles outside the described lattice that are taken for stray blobs: this share of all.
MAX_STRAY = 0.02

# Quarter turns from the target's axes to those of the numbering. The plate is seen from its front: no reflections.
QUARTER_TURNS = [np.array([[c, -s], [s, c]]) for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1))]


def detect_circle_plate(image, target: CircleTarget) -> TargetView:
    """Find the circles of a target and their places.

    Raises
    ------
    ImageError
        The image is no grey image of 8 or 16 bit.
    TargetError
        There is no lattice, a marked circle is missing, the marks do not fit the description, or circles lie outside
        the described lattice.
    """
    circles = find_circles(image)
    if len(circles) == 0:
        raise TargetError("found no circles; check that the target is in view, in focus and well exposed")
    numbers, labelled = label_lattice(circles.centres, circles.shapes)
    found = len(circles)
    circles, numbers = circles[labelled], numbers[labelled]
    if len(circles) < 4:
        raise TargetError(f"found {found} circles but they form no lattice; check that the target is in view and sharp")
    strength = mark_strength(image, circles, mark_over_circle=target.marker_diameter_mm / target.diameter_mm)
    origin, turn = _orientation(numbers, strength - np.median(strength), target, found)
    indices = (numbers - origin) @ turn + np.array(target.origin)
    inside = ((indices >= 0) & (indices < (target.columns, target.rows))).all(1)
    if np.count_nonzero(~inside) > MAX_STRAY * len(indices):
        low, high = indices.min(0), indices.max(0)
        exchanged = (indices - np.array(target.origin))[:, ::-1] + np.array(target.origin)
        fits = ((exchanged >= 0) & (exchanged < (target.columns, target.rows))).all()
        mirrored = "they fit with columns and rows exchanged, as in a mirrored image"
        advice = mirrored if fits else "check columns, rows and origin"
        raise TargetError(
            f"found circles from place ({low[0]}, {low[1]}) to ({high[0]}, {high[1]}), {np.count_nonzero(~inside)} of "
            f"{len(indices)} outside the described {target.columns} x {target.rows}; {advice}"
        )
    circles, indices = circles[inside], indices[inside]
    order = np.lexsort((indices[:, 0], indices[:, 1]))
    circles, indices = circles[order], indices[order]
    steps = (indices - np.array(target.origin)) * (target.spacing_x_mm, target.spacing_y_mm)
    return TargetView(
        pixels=circles.centres,
        points_mm=np.column_stack([steps, np.zeros(len(steps))]),
        indices=indices,
        quality={
            "residual_px": circles.residual_px,
            "contrast": circles.contrast,
            "sharpness": circles.sharpness,
            "radius_px": np.sqrt(np.linalg.det(circles.shapes)),
        },
    )


def _orientation(numbers, strength, target, found):
    """Number (2,) of the origin circle and the quarter turn (2, 2) from target steps to number steps."""
    marked = {tuple(number): value for number, value in zip(numbers.tolist(), strength, strict=True)}
    marked = {number: value for number, value in marked.items() if value > MIN_MARK_STRENGTH}
    fits = []
    for number in marked:
        for turn in QUARTER_TURNS:
            others = [tuple((np.array(number) + turn @ step).tolist()) for step in (target.marker_x, target.marker_y)]
            if all(other in marked for other in others):
                fits.append((min(marked[place] for place in (number, *others)), number, turn))
    if len(fits) == 1:
        return np.array(fits[0][1]), fits[0][2]
    seen = f"found {found} circles, {len(numbers)} of them in a lattice"
    if len(marked) < 3:
        raise TargetError(
            f"{seen}, but only {len(marked)} of 3 marked circles; bring all three into view, sharp and unobstructed"
        )
    raise TargetError(
        f"{seen}, with {len(marked)} marked circles, which fit the described offsets {target.marker_x} and "
        f"{target.marker_y} in {len(fits)} ways; expected one: check marker_x, marker_y and dirt on the circles"
    )
