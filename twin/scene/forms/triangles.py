"""Triangle meshes of smooth surfaces, with facets of a known deviation."""

from collections.abc import Iterable

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from twin.scene.surfaces import FinishProperties
from uwlts.errors import DescriptionError

_MOST_VERTICES = 4_000_000  # some 300 MB in the renderer
_RELIEF_VERTICES = 150_000  # about the most on an object: facets of 0.5 mm on a sphere of 50 mm, or one to two pixels
_RELIEF_CELLS = 96  # of a relief's field along each axis, 7 MB in all; its period is five correlation lengths or more


def require_few_vertices(vertices: int, *, step_mm: float, advice: str) -> None:
    """Check the number of vertices; DescriptionError if they would need too much memory."""
    if vertices > _MOST_VERTICES:
        raise DescriptionError(
            f"a surface in steps of {step_mm:.3g} mm needs {vertices} vertices, more than {_MOST_VERTICES}: {advice}"
        )


def chord_step(sag_mm: float, curvature: float) -> float:
    """Return the step in mm whose chord deviates by ``sag_mm`` from a curve of a curvature in 1/mm.

    A chord over a step h deviates by c h^2 / 8.
    """
    return float(np.sqrt(8 * sag_mm / curvature))


def tube(x: np.ndarray, around: np.ndarray, radius: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (V, 3) and faces (F, 3) of a tube with open ends about the x axis.

    ``x`` (N,) are positions along it, ``around`` (M,) angles from -z towards y over one turn, ``radius`` (N, M).
    """
    places = np.broadcast_to(x[:, None], radius.shape), radius * np.sin(around), -radius * np.cos(around)
    return np.stack(places, axis=-1).reshape(-1, 3), grid_faces(radius.shape, closed=True)


def space_angles(reach: float, radius: float, *, step: float, plain: float) -> np.ndarray:
    """Return angles (M,) around a tube from -z towards y.

    Steps are ``step`` mm within ``reach`` of -z, else ``plain`` mm.
    """
    front = np.linspace(-reach, reach, int(np.ceil(2 * reach * radius / step)) + 1)
    back = np.linspace(reach, 2 * np.pi - reach, int(np.ceil(2 * (np.pi - reach) * radius / plain)) + 1)
    return np.concatenate([front, back[1:-1]])


def grid_faces(shape: tuple[int, ...], *, closed: bool = False) -> np.ndarray:
    """Return triangles (F, 3) between the vertices of a grid (rows, columns), numbered row by row.

    With ``closed``, the first column follows the last one.
    """
    corner = np.arange(shape[0] * shape[1]).reshape(shape)
    beside = np.roll(corner, -1, axis=1)
    if not closed:
        corner, beside = corner[:, :-1], beside[:, :-1]
    a, b, c, d = (part.ravel() for part in (corner[:-1], beside[:-1], beside[1:], corner[1:]))
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def nodes(middles: Iterable[float], reach: float, *, step: float, length: float) -> np.ndarray:
    """Return vertex positions along one side of a plate: fine within ``reach`` of each of ``middles``, none between."""
    count = int(np.ceil(2 * reach / step)) + 1
    fine = [np.linspace(middle - reach, middle + reach, count) for middle in middles]
    return np.unique(np.concatenate([[-0.5 * length, 0.5 * length], *fine]))


def wave(place: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a smooth irregular function between -1 and 1, with wavelengths of 2 to 8 units of ``place``."""
    frequency, phase = rng.uniform(1 / 8, 1 / 2, 4), rng.uniform(0, 2 * np.pi, 4)
    return np.mean([np.sin(2 * np.pi * f * place + p) for f, p in zip(frequency, phase, strict=True)], axis=0)


def waves(places: np.ndarray, rng: np.random.Generator, *, shortest: float, longest: float) -> np.ndarray:
    """Return a smooth irregular function between -1 and 1 at ``places`` (D, ...), a sum of plane waves.

    Amplitudes are proportional to the wavelengths, as on self-similar natural surfaces. Wavelengths are spaced
    logarithmically, in the unit of the places.
    """
    count = 24  # spaced by less than 8 % over a factor of five
    direction = rng.normal(size=(count, len(places)))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    wavelength, phase = np.geomspace(shortest, longest, count), rng.uniform(0, 2 * np.pi, count)
    total = np.zeros(places.shape[1:])
    for towards, length, at in zip(direction, wavelength, phase, strict=True):
        total += length * np.cos(2 * np.pi / length * np.tensordot(towards, places, axes=1) + at)
    return total / wavelength.sum()


def bowed_plate(
    first_mm: np.ndarray, last_mm: np.ndarray, *, bow_mm: float, cells: int = 64
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices (V, 3), faces (F, 3) and uv (V, 2) of a plate between opposite corners (2,), facing -z.

    Its centre is ``bow_mm`` in front of its corners (paraboloid). uv run from 0 to 1 along x and against y.
    """
    (width, height), middle = last_mm - first_mm, (first_mm + last_mm) / 2
    u, v = np.meshgrid(np.linspace(0, 1, cells + 1), np.linspace(0, 1, cells + 1))
    x, y = (u - 0.5) * width, (0.5 - v) * height
    z = bow_mm * (x**2 + y**2) / (0.25 * (width**2 + height**2))
    return (
        np.stack([middle[0] + x, middle[1] + y, z], -1).reshape(-1, 3),
        grid_faces(x.shape),
        np.stack([u, v], -1).reshape(-1, 2),
    )


def rounded_box(size_mm: np.ndarray, *, radius_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (V, 3) and faces (F, 3) of a box (3,) about its origin with rounded edges and corners.

    A sphere of the radius is cut along the coordinate planes, and its parts are moved apart. Each edge has 24 facets
    over its quarter of a turn, whose chords deviate by radius / 8 (pi / 2 / 24)^2: 0.5 um for 1 mm.
    """
    facets = 24
    half = np.asarray(size_mm) / 2 - radius_mm
    quarter = np.linspace(0, np.pi / 2, facets + 1)
    around = np.concatenate([quarter + k * np.pi / 2 for k in range(4)])
    up = np.concatenate([quarter - np.pi / 2, quarter])
    # Signs of each part: the angles at the cuts stand twice, once on either side.
    side_x, side_y = (np.repeat(signs, facets + 1) for signs in ((1, -1, -1, 1), (1, 1, -1, -1)))
    side_z = np.repeat((-1, 1), facets + 1)
    vertices = np.stack(
        [
            half[0] * side_x + radius_mm * np.cos(around) * np.cos(up)[:, None],
            half[1] * side_y + radius_mm * np.sin(around) * np.cos(up)[:, None],
            (half[2] * side_z + radius_mm * np.sin(up))[:, None] + np.zeros(len(around)),
        ],
        axis=-1,
    ).reshape(-1, 3)
    corner = np.arange(len(vertices)).reshape(len(up), len(around))
    faces = grid_faces(corner.shape, closed=True)
    # Bottom and top are the rectangles between the poles of the four parts.
    bottom, top = corner[0, :: facets + 1], corner[-1, :: facets + 1]
    caps = [(bottom[0], bottom[3], bottom[2]), (bottom[0], bottom[2], bottom[1]), top[[0, 1, 2]], top[[0, 2, 3]]]
    faces = np.concatenate([faces, np.array(caps)])
    # Triangles at the poles have no area.
    return vertices, faces[np.linalg.norm(_compute_normals(vertices, faces), axis=1) > 0]


def add_relief(
    surface: tuple[np.ndarray, ...], own: FinishProperties, rng: np.random.Generator
) -> tuple[np.ndarray, ...]:
    """Displace a surface along its normals by random heights.

    ``surface`` is vertices (V, 3), faces (F, 3), and optionally texture coordinates (V, 2). The heights are a Gaussian
    field in space with the spectral density (1 + q^2)^-(H + 3/2) (von Karman). The wave vector q is in units of the
    inverse correlation lengths, and H is the Hurst exponent. Waves are not shorter than two facets, of a twentieth of
    the correlation length or as small as `_RELIEF_VERTICES` allow.
    """
    vertices, faces, *uv = surface
    lengths = np.ones(3) * own.relief_length_mm
    area = 0.5 * float(np.linalg.norm(_compute_normals(vertices, faces), axis=1).sum())
    step = max(float(lengths.min()) / 20, 2 * float(np.sqrt(area / _RELIEF_VERTICES)))
    values, faces = _split_edges(np.hstack([vertices, *uv]), faces, step)
    fine, cell = np.ascontiguousarray(values[:, :3]), step / float(lengths.min())
    # Fine and coarse waves; each field is periodic, but turned at random it does not repeat along a surface.
    height, variance, number = np.zeros(len(values)), 0.0, np.fft.fftfreq(_RELIEF_CELLS)
    for size, least in ((cell, 0.125 / cell), (4 * cell, 0.0)):
        k = np.sqrt(number[:, None, None] ** 2 + number[:, None] ** 2 + number[: _RELIEF_CELLS // 2 + 1] ** 2) / size
        density = (1 + (2 * np.pi * k) ** 2) ** -(own.relief_exponent + 1.5) * (k > least) * (k <= 0.5 / size)
        field = np.fft.irfftn(np.fft.rfftn(rng.standard_normal((_RELIEF_CELLS,) * 3)) * np.sqrt(density / size**3))
        places = fine / lengths @ Rotation.from_quat(rng.standard_normal(4)).as_matrix() / size
        height += map_coordinates(field, places.T, order=3, mode="grid-wrap")
        variance += field.var()
    height *= own.relief_mm / np.sqrt(variance)
    # The normal of a vertex is the mean of its facets', weighted by their areas.
    corners = np.repeat(_compute_normals(fine, faces), 3, axis=0).T
    outward = np.stack([np.bincount(faces.ravel(), each, len(fine)) for each in corners], axis=1)
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), np.finfo(float).tiny)
    return fine + outward * height[:, None], faces, *([values[:, 3:]] if uv else [])


def _compute_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the normals (F, 3) of triangles, twice as long as their areas in mm2."""
    a, b, c = (vertices[corner] for corner in faces.T)
    return np.cross(b - a, c - a)


def _split_edges(values: np.ndarray, faces: np.ndarray, longest: float) -> tuple[np.ndarray, np.ndarray]:
    """Halve edges until none exceeds ``longest``; the first three columns of ``values`` (V, K) are places.

    A slender triangle, with one short edge, becomes a smaller one and a strip, which is then cut across only: halves of
    triangles alone would stay slender, and make millions of a pipe's facets.
    """
    done, strips = [], np.zeros((0, 4), int)  # corners a, b, c, d: b to c and d to a are short
    while len(faces) or len(strips):
        ends = [np.stack([cells, np.roll(cells, -1, axis=1)], -1).reshape(-1, 2) for cells in (faces, strips)]
        first, second = (order(*np.concatenate(ends).T) for order in (np.minimum, np.maximum))
        long = np.square(values[first, :3] - values[second, :3]).sum(axis=1) > longest**2
        edges, number = np.unique(first[long] * len(values) + second[long], return_inverse=True)
        middle = np.full(len(long), -1)
        middle[long] = len(values) + number
        of_faces, of_strips = middle[: faces.size].reshape(-1, 3), middle[faces.size :].reshape(-1, 4)
        first, second = np.divmod(edges, len(values))
        values = np.vstack([values, (values[first] + values[second]) / 2])
        count = np.sum(of_faces >= 0, axis=1)
        done.append(faces[count == 0])
        # The only long edge comes first, the only short one last.
        turn = np.where(count == 2, np.argmin(of_faces, axis=1) + 1, np.argmax(of_faces >= 0, axis=1))
        order = (np.arange(3) + turn[:, None]) % 3
        corners = np.hstack([np.take_along_axis(each, order, axis=1) for each in (faces, of_faces)])
        cells: list[tuple[np.ndarray, ...]] = []
        a, b, c, ab, bc, ca = corners[count == 1].T
        cells += (a, ab, c), (ab, b, c)
        a, b, c, ab, bc, ca = corners[count == 2].T
        cells += (ab, b, bc), (a, ab, bc, c)
        a, b, c, ab, bc, ca = corners[count == 3].T
        cells += (a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)
        # If one of a strip's sides is long, it comes first.
        order = (np.arange(4) + 2 * (of_strips[:, :1] < 0)) % 4
        corners = np.hstack([np.take_along_axis(each, order, axis=1) for each in (strips, of_strips)])
        count = np.sum(of_strips >= 0, axis=1)
        a, b, c, d, *_ = corners[count == 0].T
        cells += (a, b, c), (a, c, d)
        a, b, c, d, ab, *_ = corners[count == 1].T
        cells += (a, ab, d), (ab, b, c), (ab, c, d)
        a, b, c, d, ab, _, cd, _ = corners[count == 2].T
        cells += (a, ab, cd, d), (ab, b, c, cd)
        faces, strips = (np.concatenate([np.stack(each, 1) for each in cells if len(each) == k]) for k in (3, 4))
    return values, np.concatenate(done)
