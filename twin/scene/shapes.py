"""Free-form objects as fine triangle meshes of smooth functions: a dummy head, weld beads on a plate, a pitted pipe.

All face -z, towards the sensor. Their front is known in closed form (`head_depth`, `weld_height`, `pitted_radius`), and
the vertices lie on it; between them, facets cut corners by some micrometres.
"""

from collections.abc import Iterable
from functools import lru_cache

import numpy as np

from twin.scene.description import PittedPipe, Weld
from uwlts.model.errors import DescriptionError

# Unit of the head's tables is its height, from the neck's cut at y = -0.5 to the crown at 0.5.
# Bodies of half-ellipses, front and back, about the y axis: y of the middle, half height, flatness of the ends, half
# width, front, back.
_BODIES = np.array(
    [
        (0.150, 0.350, 2.0, 0.285, 0.330, 0.340),  # skull
        (-0.110, 0.285, 3.0, 0.220, 0.325, 0.150),  # jaw
        (-0.550, 0.450, 6.0, 0.135, 0.130, 0.200),  # neck
    ]
)
_UNION_POWER = 6
# Gaussian hills on the face: x (with its mirror image, where it is not 0), y, their sigmas, and how far they stand out.
_FEATURES = np.array(
    [
        (0.090, 0.155, 0.055, 0.025, 0.018),  # brows
        (0.095, 0.090, 0.042, 0.030, -0.050),  # sockets
        (0.095, 0.084, 0.026, 0.020, 0.032),  # eyes
        (0.150, -0.015, 0.045, 0.040, 0.022),  # cheekbones
        (0.105, -0.120, 0.040, 0.050, -0.016),  # cheeks
        (0.000, 0.080, 0.024, 0.045, 0.024),  # bridge of the nose
        (0.000, 0.010, 0.024, 0.045, 0.055),  # its ridge
        (0.000, -0.060, 0.028, 0.030, 0.085),  # its tip
        (0.036, -0.072, 0.020, 0.022, 0.034),  # its wings
        (0.000, -0.163, 0.042, 0.015, 0.020),  # upper lip
        (0.000, -0.205, 0.038, 0.016, 0.022),  # lower lip
        (0.000, -0.290, 0.045, 0.032, 0.035),  # chin
    ]
)
_ROWS, _COLUMNS, _FINER_IN_FRONT = 900, 640, 0.45
"""Facets of a head: rows from crown to neck, columns round it, and how much finer than even these are on the face."""
_TRAIL = 1 / 3
"""Distance that ripples trail at a bead's toes, in its widths."""
_SAG_MM = 0.004
"""Largest distance of a weld's facets from its surface."""
_MOST_VERTICES = 4_000_000
_PIT_SAG_MM = 0.01
"""Largest distance of a pitted pipe's facets from its surface."""
_PITTED_DEG = 60.0
"""Pits lie within this angle of the side that faces the sensor."""


def head_depth(x: np.ndarray, y: np.ndarray, *, height_mm: float) -> np.ndarray:
    """Position of a head's front along z at places ``x``, ``y`` (N,), all in mm; NaN beside its outline."""
    x, y = x / height_mm, y / height_mm
    half_width, front, _ = _outline(y)
    with np.errstate(divide="ignore", invalid="ignore"):
        facing = np.sqrt(1 - np.square(x / half_width))
    return height_mm * np.where(np.abs(y) <= 0.5, _front(x, y, front, facing), np.nan)


@lru_cache(maxsize=4)
def head_surface(*, height_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """A dummy head with the stub of its neck: vertices (V, 3) in mm and faces (F, 3) of a closed surface.

    The y axis runs from the neck through the middle of the skull to the crown; the face looks along -z. ``height_mm``
    is the whole height; everything else is in proportion: 0.57 wide, and 0.79 from nose to back.
    """
    # Rows at equal distances along the front's outline, from the crown, where it is level, to the neck.
    y = 0.5 - np.square(np.linspace(0, 1, 20 * _ROWS))
    way = np.concatenate([[0], np.cumsum(np.hypot(np.diff(y), np.diff(_outline(y)[1])))])
    y = np.interp(np.linspace(0, way[-1], _ROWS + 1), way, y)[1:, None]
    angle = np.linspace(-np.pi, np.pi, _COLUMNS, endpoint=False)
    angle = angle - _FINER_IN_FRONT * np.sin(angle)
    half_width, front, back = _outline(y)
    x, facing = half_width * np.sin(angle), np.broadcast_to(np.cos(angle), (_ROWS, _COLUMNS))
    z = np.where(facing > 0, _front(x, y, front, facing), -back * facing)
    sides = np.stack([x, np.broadcast_to(y, x.shape), z], axis=-1).reshape(-1, 3)

    ring = np.arange(_COLUMNS)
    corner = (np.arange(_ROWS - 1)[:, None] * _COLUMNS + ring).ravel()
    beside = (np.arange(_ROWS - 1)[:, None] * _COLUMNS + np.roll(ring, -1)).ravel()
    crown, cut = len(sides), len(sides) + 1
    last = crown - _COLUMNS + ring
    faces = np.concatenate(
        [
            _quads(corner, beside, beside + _COLUMNS, corner + _COLUMNS),
            np.stack([np.full_like(ring, crown), np.roll(ring, -1), ring], axis=1),
            np.stack([np.full_like(ring, cut), last, np.roll(last, -1)], axis=1),
        ]
    )
    return _locked(height_mm * np.concatenate([sides, [[0, 0.5, 0], [0, -0.5, 0]]]), faces)


def _outline(y: np.ndarray) -> np.ndarray:
    """Half width, front and back (3, ...) of the head's bodies at heights y (...), melted into each other."""
    middle, half, flatness, *radii = (column[:, *[None] * np.ndim(y)] for column in _BODIES.T)
    share = np.sqrt(np.maximum(1 - np.abs((y - middle) / half) ** flatness, 0))
    return np.stack([np.sum((radius * share) ** _UNION_POWER, axis=0) ** (1 / _UNION_POWER) for radius in radii])


def _front(x: np.ndarray, y: np.ndarray, front: np.ndarray, facing: np.ndarray) -> np.ndarray:
    """Depth z of the face; ``facing`` (1 in the middle, 0 at the sides) fades the features out."""
    relief = sum(
        height * np.exp(-0.5 * (np.square((x - side * at_x) / sigma_x) + np.square((y - at_y) / sigma_y)))
        for at_x, at_y, sigma_x, sigma_y, height in _FEATURES
        for side in ((1, -1) if at_x else (1,))
    )
    return -front * facing - relief * np.square(facing)


def weld_height(weld: Weld, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Height of the beads of a weld above its plate, towards -z, at places ``x``, ``y`` (N,), all in mm.

    A bead is `height_mm` (1 - t^2)^2, with t from 0 in its middle to 1 at its toes and round ends, and cosine ripples
    on it: crescents that trail at the sides. An undercut is a groove of `undercut_depth_mm` (1 - u^2)^2 about each toe,
    with u from 0 in its middle to 1 at its rims, which ends with the straight part of the bead.
    """
    along, across = (x, y) if weld.along == "x" else (y, x)
    height = np.zeros(np.broadcast(x, y).shape)
    for number, middle in enumerate(_bead_middles(weld)):
        rng = np.random.default_rng([weld.seed, number])
        swell, thickness, sway, hurry = (weld.irregularity * _wave(along / weld.width_mm, rng) for _ in range(4))
        sideways = (across - middle - weld.width_mm * sway) / (0.5 * weld.width_mm * (1 + swell))
        beyond = np.maximum(np.abs(along) - 0.5 * (weld.length_mm - weld.width_mm), 0) / (0.5 * weld.width_mm)
        envelope = np.square(np.maximum(1 - np.square(sideways) - np.square(beyond), 0))
        crests = (along + _TRAIL * weld.width_mm * np.square(sideways)) / weld.ripple_pitch_mm + hurry
        ripple = 0.5 * weld.ripple_height_mm * np.cos(2 * np.pi * crests)
        height += envelope * (weld.height_mm * (1 + thickness) + ripple)
        if weld.undercut_depth_mm:
            from_toe = (np.abs(sideways) - 1) * weld.width_mm * (1 + swell) / weld.undercut_width_mm
            ends = np.square(np.maximum(1 - np.square(beyond), 0))
            height -= weld.undercut_depth_mm * ends * np.square(np.maximum(1 - np.square(from_toe), 0))
    return height


@lru_cache(maxsize=4)
def weld_surface(weld: Weld) -> tuple[np.ndarray, np.ndarray]:
    """A plate in the x-y plane with weld beads on its front: vertices (V, 3) in mm and faces (F, 3) of an open surface.

    Facets deviate from `weld_height` by `_SAG_MM`. DescriptionError where ripples so small or steep on so long beads
    need too many vertices.
    """
    # A chord over a step h of a curve of second derivative c deviates from it by c h^2 / 8.
    ripple = 0.5 * weld.ripple_height_mm * (2 * np.pi / weld.ripple_pitch_mm) ** 2
    toe = 8 * weld.height_mm / (0.5 * weld.width_mm) ** 2
    undercut = 8 * weld.undercut_depth_mm / (0.5 * weld.undercut_width_mm) ** 2
    step = np.sqrt(8 * _SAG_MM / (1.3 * ripple + toe + undercut))
    plate = weld.plate_mm if weld.along == "x" else weld.plate_mm[::-1]
    along = _nodes([0.0], 0.5 * weld.length_mm, step=step, length=plate[0])
    across = _nodes(_bead_middles(weld), weld.bead_reach_mm(), step=step, length=plate[1])
    if len(along) * len(across) > _MOST_VERTICES:
        raise DescriptionError(
            f"a weld in steps of {step:.3g} mm needs {len(along) * len(across)} vertices, more than {_MOST_VERTICES}: "
            "make its ripples longer or lower, or its beads fewer or shorter"
        )
    x, y = np.meshgrid(*((along, across) if weld.along == "x" else (across, along)), indexing="ij")
    return _locked(np.stack([x, y, -weld_height(weld, x, y)], axis=-1).reshape(-1, 3), _grid_faces(x.shape))


def pit_places(pipe: PittedPipe) -> np.ndarray:
    """Places (pits, 2) of the middles of a pipe's pits: x in mm, and the angle in rad from -z towards y."""
    most = 0.5 * (pipe.length_mm - pipe.pit_diameter_mm), np.radians(_PITTED_DEG)
    return np.random.default_rng(pipe.seed).uniform(-1, 1, (pipe.pits, 2)) * most


def pitted_radius(pipe: PittedPipe, x: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Distance of a pitted pipe's surface from its axis at ``x`` in mm and angles in rad from -z towards y.

    R (1 + ovality / 2 cos(2 angle)), less the depth of the deepest pit there: `pit_depth_mm` (1 - t^2)^2, with t from 0
    in a pit's middle to 1 at its rim, measured along the surface of the round pipe.
    """
    round_mm, pit_mm = pipe.diameter_mm / 2, pipe.pit_diameter_mm / 2
    depth = np.zeros(np.broadcast(x, angle).shape)
    for at_x, at_angle in pit_places(pipe):
        squared = (np.square(x - at_x) + np.square(round_mm * (angle - at_angle))) / pit_mm**2
        depth = np.maximum(depth, pipe.pit_depth_mm * np.square(np.maximum(1 - squared, 0)))
    return round_mm * (1 + 0.5 * pipe.ovality * np.cos(2 * angle)) - depth


@lru_cache(maxsize=4)
def pitted_surface(pipe: PittedPipe) -> tuple[np.ndarray, np.ndarray]:
    """A pitted pipe: vertices (V, 3) in mm and faces (F, 3) of a tube that is open at its ends.

    Facets deviate from `pitted_radius` by `_PIT_SAG_MM`, by up to ten times that at creases between overlapping pits.
    DescriptionError where pits so small and deep on so large a pipe need too many vertices.
    """
    # As of a weld: chords of the round pipe, and of pits, whose second derivative is largest at the rim.
    radius = pipe.diameter_mm / 2
    step = np.sqrt(8 * _PIT_SAG_MM / (1 / radius + 8 * pipe.pit_depth_mm / (0.5 * pipe.pit_diameter_mm) ** 2))
    plain = np.sqrt(8 * _PIT_SAG_MM * radius)
    reach = np.radians(_PITTED_DEG) + 0.5 * pipe.pit_diameter_mm / radius if pipe.pits else 0.0
    front = np.linspace(-reach, reach, int(np.ceil(2 * reach * radius / step)) + 1)
    back = np.linspace(reach, 2 * np.pi - reach, int(np.ceil(2 * (np.pi - reach) * radius / plain)) + 1)
    angle = np.concatenate([front, back[1:-1]])
    x = (
        np.linspace(-0.5, 0.5, int(np.ceil(pipe.length_mm / (step if pipe.pits else pipe.length_mm))) + 1)
        * pipe.length_mm
    )
    if len(x) * len(angle) > _MOST_VERTICES:
        raise DescriptionError(
            f"a pitted pipe in steps of {step:.3g} mm needs {len(x) * len(angle)} vertices, more than {_MOST_VERTICES}"
            ": make its pits wider or flatter, or the pipe smaller"
        )
    along, around = np.meshgrid(x, angle, indexing="ij")
    # Behind, angles run beyond pi, where no pit is.
    distance = pitted_radius(pipe, along, np.where(around > np.pi, around - 2 * np.pi, around))
    vertices = np.stack([along, distance * np.sin(around), -distance * np.cos(around)], axis=-1).reshape(-1, 3)
    corner = np.arange(len(x) * len(angle)).reshape(len(x), len(angle))
    beside = np.roll(corner, -1, axis=1)
    return _locked(vertices, _quads(*(part.ravel() for part in (corner[:-1], beside[:-1], beside[1:], corner[1:]))))


def _bead_middles(weld: Weld) -> np.ndarray:
    """Places (beads,) of the beads' middle lines across them."""
    return weld.spacing_mm * (np.arange(weld.beads) - 0.5 * (weld.beads - 1))


def _nodes(middles: Iterable[float], reach: float, *, step: float, length: float) -> np.ndarray:
    """Places of vertices along one side of the plate: fine up to ``reach`` from each middle, none on flat ground."""
    count = int(np.ceil(2 * reach / step)) + 1
    fine = [np.linspace(middle - reach, middle + reach, count) for middle in middles]
    return np.unique(np.concatenate([[-0.5 * length, 0.5 * length], *fine]))


def _wave(place: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A smooth irregular function between -1 and 1, with waves of 2 to 8 units of ``place``."""
    frequency, phase = rng.uniform(1 / 8, 1 / 2, 4), rng.uniform(0, 2 * np.pi, 4)
    return np.mean([np.sin(2 * np.pi * f * place + p) for f, p in zip(frequency, phase, strict=True)], axis=0)


def _grid_faces(shape: tuple[int, int]) -> np.ndarray:
    """Triangles (F, 3) between the vertices of a grid (rows, columns), numbered row by row."""
    corner = np.arange(shape[0] * shape[1]).reshape(shape)
    return _quads(*(part.ravel() for part in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1])))


def _quads(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Triangles (2 N, 3) of quadrangles whose corners (N,) run round in this order."""
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def _locked(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The arrays, no longer to be written to: they are kept for the next caller."""
    vertices.flags.writeable = faces.flags.writeable = False
    return vertices, faces


def bowed_plate(
    first_mm: np.ndarray, last_mm: np.ndarray, *, bow_mm: float, cells: int = 64
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (V, 3), faces (F, 3) and uv (V, 2) of a plate between two opposite corners (2,) that faces -z.

    Its middle stands ``bow_mm`` before its corners, as on a sphere. uv run from 0 to 1 along x and against y.
    """
    (width, height), middle = last_mm - first_mm, (first_mm + last_mm) / 2
    u, v = np.meshgrid(np.linspace(0, 1, cells + 1), np.linspace(0, 1, cells + 1))
    x, y = (u - 0.5) * width, (0.5 - v) * height
    z = bow_mm * (x**2 + y**2) / (0.25 * (width**2 + height**2))
    return (
        np.stack([middle[0] + x, middle[1] + y, z], -1).reshape(-1, 3),
        _grid_faces(x.shape),
        np.stack([u, v], -1).reshape(-1, 2),
    )
