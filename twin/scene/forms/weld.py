"""Weld beads on a plate, with ripples and undercut."""

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from twin.scene.forms.triangles import chord_step, grid_faces, nodes, require_few_vertices, wave
from twin.scene.scene_object import FreeForm, Range
from uwlts.model.sensor import NotNegative, Positive

_TRAIL = 1 / 3  # lag of the ripples at a bead's toes, in units of its width
_DEPTHS_STREAM = 1_000_000
"""Stream of random numbers of undercuts, separate from those of beads, which are numbered from 0."""
_SAG_MM = 0.004  # largest distance of a weld's facets from its surface


class Weld(FreeForm):
    """Rippled weld beads on the front of a plate in its own x-y plane, facing -z (towards the sensor).

    The beads run along the plate's x or y axis (``along``), ``spacing_mm`` apart. ``length_mm``, ``width_mm`` and
    ``height_mm`` are those of one bead; ``ripple_height_mm`` is measured from trough to crest. ``irregularity`` is the
    relative variation of width and height, and the displacement of path and ripples in units of width and pitch; it is
    drawn from ``seed``. Grooves of ``undercut_depth_mm`` and ``undercut_width_mm`` run along both toes of each bead; a
    pair [least, most] of depths draws the depth of each (`undercut_depths`).
    """

    kind: Literal["weld"]
    plate_mm: tuple[Positive, Positive] = (80.0, 120.0)
    beads: Annotated[int, Field(ge=1, le=100)] = 3
    spacing_mm: Positive = 18.0
    along: Literal["x", "y"] = "x"
    length_mm: Positive = 56.0
    width_mm: Positive = 10.0
    height_mm: Positive = 2.0
    ripple_pitch_mm: Positive = 3.0
    ripple_height_mm: NotNegative = 0.25
    irregularity: Annotated[float, Field(ge=0, le=0.3)] = 0.06
    undercut_depth_mm: NotNegative | Range = 0.0
    undercut_width_mm: Positive = 1.5
    seed: Annotated[int, Field(ge=0)] = 0

    def bead_reach_mm(self) -> float:
        """Return the largest lateral extent of a bead from its nominal centre line, including irregularities."""
        groove = 0.5 * self.undercut_width_mm if self.undercut_depth_mm else 0.0
        return self.width_mm * (0.5 + 1.5 * self.irregularity) + groove

    @model_validator(mode="after")
    def _beads_have_room(self) -> "Weld":
        plate = self.plate_mm if self.along == "x" else self.plate_mm[::-1]
        wide = (self.beads - 1) * self.spacing_mm + 2 * self.bead_reach_mm()
        if self.length_mm < self.width_mm:
            raise ValueError(f"a bead of length_mm {self.length_mm:g} is shorter than its width_mm {self.width_mm:g}")
        if self.beads > 1 and self.spacing_mm < 2 * self.bead_reach_mm():
            touching = f"lets beads touch that may be {2 * self.bead_reach_mm():g} mm wide"
            raise ValueError(f"spacing_mm {self.spacing_mm:g} {touching}")
        if self.length_mm > plate[0] or wide > plate[1]:
            raise ValueError(
                f"beads of {self.length_mm:g} mm along {self.along} and {wide:g} mm together across it do not fit on "
                f"plate_mm {self.plate_mm[0]:g} x {self.plate_mm[1]:g}"
            )
        if self.ripple_height_mm > 2 * (1 - self.irregularity) * self.height_mm:
            raise ValueError(
                f"ripple_height_mm {self.ripple_height_mm:g} lets troughs dip into the plate under a bead of height_mm "
                f"{self.height_mm:g}"
            )
        return self

    def triangles(self) -> tuple[np.ndarray, np.ndarray]:
        """Return an open surface whose facets deviate from `weld_height` by `_SAG_MM`.

        DescriptionError if small or steep ripples on long beads require too many vertices.
        """
        ripple = 0.5 * self.ripple_height_mm * (2 * np.pi / self.ripple_pitch_mm) ** 2
        toe = 8 * self.height_mm / (0.5 * self.width_mm) ** 2
        undercut = 8 * float(undercut_depths(self).max()) / (0.5 * self.undercut_width_mm) ** 2
        step = chord_step(_SAG_MM, 1.3 * ripple + toe + undercut)
        plate = self.plate_mm if self.along == "x" else self.plate_mm[::-1]
        along = nodes([0.0], 0.5 * self.length_mm, step=step, length=plate[0])
        across = nodes(_bead_middles(self), self.bead_reach_mm(), step=step, length=plate[1])
        advice = "make its ripples longer or lower, or its beads fewer or shorter"
        require_few_vertices(len(along) * len(across), step_mm=step, advice=advice)
        x, y = np.meshgrid(*((along, across) if self.along == "x" else (across, along)), indexing="ij")
        return np.stack([x, y, -weld_height(self, x, y)], axis=-1).reshape(-1, 3), grid_faces(x.shape)

    def draws_depths(self) -> bool:
        return isinstance(self.undercut_depth_mm, tuple)


def undercut_depths(weld: Weld) -> np.ndarray:
    """Return the depths (beads, 2) in mm of the grooves on the negative and positive side across each bead.

    Depths of a range are drawn evenly in the logarithm.
    """
    if not isinstance(weld.undercut_depth_mm, tuple):
        return np.full((weld.beads, 2), float(weld.undercut_depth_mm))
    least, most = np.log(weld.undercut_depth_mm)
    return np.exp(np.random.default_rng([weld.seed, _DEPTHS_STREAM]).uniform(least, most, (weld.beads, 2)))


def weld_height(weld: Weld, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the height of weld beads above the plate, towards -z, at ``x``, ``y`` (N,), all in mm.

    A bead is `height_mm` (1 - t^2)^2, where t is 0 at its centre and 1 at its toes and round ends, with cosine ripples
    that lag at the sides. An undercut is a groove d (1 - u^2)^2 along each toe, with d from `undercut_depths`, where u
    is 0 at its centre and 1 at its rims. It ends with the straight part of the bead.
    """
    along, across = (x, y) if weld.along == "x" else (y, x)
    height = np.zeros(np.broadcast(x, y).shape)
    for number, (middle, grooves) in enumerate(zip(_bead_middles(weld), undercut_depths(weld), strict=True)):
        rng = np.random.default_rng([weld.seed, number])
        swell, thickness, sway, hurry = (weld.irregularity * wave(along / weld.width_mm, rng) for _ in range(4))
        sideways = (across - middle - weld.width_mm * sway) / (0.5 * weld.width_mm * (1 + swell))
        beyond = np.maximum(np.abs(along) - 0.5 * (weld.length_mm - weld.width_mm), 0) / (0.5 * weld.width_mm)
        envelope = np.square(np.maximum(1 - np.square(sideways) - np.square(beyond), 0))
        crests = (along + _TRAIL * weld.width_mm * np.square(sideways)) / weld.ripple_pitch_mm + hurry
        ripple = 0.5 * weld.ripple_height_mm * np.cos(2 * np.pi * crests)
        height += envelope * (weld.height_mm * (1 + thickness) + ripple)
        if grooves.any():
            from_toe = (np.abs(sideways) - 1) * weld.width_mm * (1 + swell) / weld.undercut_width_mm
            ends = np.square(np.maximum(1 - np.square(beyond), 0))
            height -= np.where(sideways < 0, *grooves) * ends * np.square(np.maximum(1 - np.square(from_toe), 0))
    return height


def _bead_middles(weld: Weld) -> np.ndarray:
    """Return the positions (beads,) of the beads' centre lines across them."""
    return weld.spacing_mm * (np.arange(weld.beads) - 0.5 * (weld.beads - 1))
