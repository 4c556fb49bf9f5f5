"""Parts: weld beads on a plate, and a corroded, slightly oval pipe with pits."""

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from twin.scene.forms.triangles import chord_step, grid_faces, nodes, require_few_vertices, space_angles, tube, wave
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
    def _check_room(self) -> "Weld":
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
        across = nodes(_place_beads(self), self.bead_reach_mm(), step=step, length=plate[1])
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
    for number, (middle, grooves) in enumerate(zip(_place_beads(weld), undercut_depths(weld), strict=True)):
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


def _place_beads(weld: Weld) -> np.ndarray:
    """Return the positions (beads,) of the beads' centre lines across them."""
    return weld.spacing_mm * (np.arange(weld.beads) - 0.5 * (weld.beads - 1))


# --- pitted pipe ------------------------------------------------------------------------------------------------------


_PIT_SAG_MM = 0.01  # largest distance of a pitted pipe's facets from its surface
_DRAWN_PIT_SAG_MM = 0.002  # the same for pits of drawn depths, which may be as shallow as the noise of points
_PITTED_DEG = 60.0  # pits are within this angle of the side that faces the sensor
_MOST_COVERED = 0.45
"""Largest share of the area that discs with gaps may cover; random placing ends at 0.547 (Feder 1980)."""
_PIT_STREAM = 1  # stream of random numbers of depths, separate from that of positions


class PittedPipe(FreeForm):
    """The outer surface of a corroded, slightly oval pipe, along its own x axis and centred at its origin.

    The largest diameter is along z, the smallest perpendicular to it; ``ovality`` is their difference divided by their
    mean, ``diameter_mm``. ``pits`` pits of ``pit_diameter_mm`` and ``pit_depth_mm`` are within 60 deg of -z at random
    positions from ``seed`` (`pit_places`). A pair [least, most] of depths draws each pit's depth (`pit_depths`).
    ``pit_gap_mm`` is the least distance between the rims of pits; without it, pits may overlap.
    """

    kind: Literal["pitted_pipe"]
    diameter_mm: Positive = 100.0
    length_mm: Positive = 120.0
    ovality: Annotated[float, Field(ge=0, le=0.2)] = 0.0
    pits: Annotated[int, Field(ge=0, le=1000)] = 12
    pit_diameter_mm: Positive = 10.0
    pit_depth_mm: NotNegative | Range = 2.0
    pit_gap_mm: NotNegative | None = None
    seed: Annotated[int, Field(ge=0)] = 0

    @model_validator(mode="after")
    def _check_pits(self) -> Self:
        if self.pit_diameter_mm > min(self.length_mm, self.diameter_mm / 2):
            raise ValueError(
                f"pit_diameter_mm {self.pit_diameter_mm:g} is more than length_mm {self.length_mm:g}, or than half of "
                f"diameter_mm {self.diameter_mm:g}"
            )
        if self.deepest_mm() > self.diameter_mm / 4:
            raise ValueError(
                f"pit_depth_mm {self.deepest_mm():g} is more than a quarter of diameter_mm {self.diameter_mm:g}"
            )
        if self.pit_gap_mm is not None:
            disc = self.pits * np.pi / 4 * (self.pit_diameter_mm + self.pit_gap_mm) ** 2
            share = disc / float(np.prod(2 * np.array(_find_pitted_area(self)) * (1, self.diameter_mm / 2)))
            if share > _MOST_COVERED:
                raise ValueError(
                    f"pits {self.pits} of {self.pit_diameter_mm:g} mm with a pit_gap_mm of {self.pit_gap_mm:g} would "
                    f"cover {100 * share:.0f} % of their area; at most {100 * _MOST_COVERED:.0f} % can be placed"
                )
        return self

    def draws_depths(self) -> bool:
        return isinstance(self.pit_depth_mm, tuple)

    def deepest_mm(self) -> float:
        """Return the largest possible depth of a pit."""
        return self.pit_depth_mm[1] if isinstance(self.pit_depth_mm, tuple) else self.pit_depth_mm

    def triangles(self) -> tuple[np.ndarray, np.ndarray]:
        """Return a tube with open ends.

        Facets deviate from `pitted_radius` by `_PIT_SAG_MM`, or by a fifth of that if depths are drawn; by up to ten
        times that at creases between overlapping pits. DescriptionError if small and deep pits on a large pipe require
        too many vertices.
        """
        # The second derivative of a pit is largest at its rim.
        radius = self.diameter_mm / 2
        sag = _DRAWN_PIT_SAG_MM if isinstance(self.pit_depth_mm, tuple) else _PIT_SAG_MM
        step = chord_step(sag, 1 / radius + 8 * self.deepest_mm() / (0.5 * self.pit_diameter_mm) ** 2)
        plain = chord_step(_PIT_SAG_MM, 1 / radius)
        reach = np.radians(_PITTED_DEG) + 0.5 * self.pit_diameter_mm / radius if self.pits else 0.0
        around = space_angles(reach, radius, step=step, plain=plain)
        rings = int(np.ceil(self.length_mm / (step if self.pits else self.length_mm))) + 1
        advice = "make its pits wider or flatter, or the pipe smaller"
        require_few_vertices(rings * len(around), step_mm=step, advice=advice)
        x = np.linspace(-0.5, 0.5, rings) * self.length_mm
        # Angles at the back, without pits, exceed pi.
        return tube(x, around, pitted_radius(self, x[:, None], np.where(around > np.pi, around - 2 * np.pi, around)))


def pit_places(pipe: PittedPipe) -> np.ndarray:
    """Return positions (pits, 2) of the centres of a pipe's pits: x in mm, and the angle in rad from -z towards y."""
    most, rng = _find_pitted_area(pipe), np.random.default_rng(pipe.seed)
    if pipe.pit_gap_mm is None:
        return rng.uniform(-1, 1, (pipe.pits, 2)) * most
    # A candidate too near to earlier pits is drawn again; the limit of the covered area leaves room for all.
    places, scale = np.zeros((0, 2)), np.array([1.0, pipe.diameter_mm / 2])
    while len(places) < pipe.pits:
        drawn = rng.uniform(-1, 1, (1, 2)) * most
        distance = np.linalg.norm((places - drawn) * scale, axis=1)
        if not (distance < pipe.pit_diameter_mm + pipe.pit_gap_mm).any():
            places = np.concatenate([places, drawn])
    return places


def pit_depths(pipe: PittedPipe) -> np.ndarray:
    """Return the depths (pits,) in mm; depths of a range are even in the logarithm, in random order."""
    if not isinstance(pipe.pit_depth_mm, tuple):
        return np.full(pipe.pits, float(pipe.pit_depth_mm))
    rng = np.random.default_rng([pipe.seed, _PIT_STREAM])
    share = (rng.permutation(pipe.pits) + rng.random(pipe.pits)) / max(pipe.pits, 1)
    return np.exp(np.interp(share, [0, 1], np.log(pipe.pit_depth_mm)))


def _find_pitted_area(pipe: PittedPipe) -> tuple[float, float]:
    """Return the largest x in mm and angle in rad of a pit's centre."""
    return 0.5 * (pipe.length_mm - pipe.pit_diameter_mm), float(np.radians(_PITTED_DEG))


def pitted_radius(pipe: PittedPipe, x: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return the distance of a pitted pipe's surface from its axis at ``x`` in mm and angles in rad from -z to y.

    R (1 + ovality / 2 cos(2 angle)), minus the depth of the deepest pit: d (1 - t^2)^2 with d from `pit_depths`, where
    t is 0 at the pit's centre and 1 at its rim, measured along the surface of the round pipe.
    """
    round_mm, pit_mm = pipe.diameter_mm / 2, pipe.pit_diameter_mm / 2
    depth = np.zeros(np.broadcast(x, angle).shape)
    for (at_x, at_angle), deep in zip(pit_places(pipe), pit_depths(pipe), strict=True):
        squared = (np.square(x - at_x) + np.square(round_mm * (angle - at_angle))) / pit_mm**2
        depth = np.maximum(depth, deep * np.square(np.maximum(1 - squared, 0)))
    return round_mm * (1 + 0.5 * pipe.ovality * np.cos(2 * angle)) - depth
