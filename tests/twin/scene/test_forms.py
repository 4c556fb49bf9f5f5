"""Sea floor and other forms: sizes, topology, and deviation of facets from the functions."""

import math

import numpy as np
import pytest
import trimesh
from pydantic import ValidationError

from twin.scene.forms import Seabed
from twin.scene.forms.seabed import _compute_sediment_height
from twin.scene.forms.triangles import add_relief, bowed_plate, rounded_box, tube
from twin.scene.scene_object import FreeForm
from twin.scene.surfaces import FinishProperties


def seabed_height(bed: Seabed, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the height of the sea floor towards -z at ``x``, ``y`` (N,), all in mm.

    Sum of cosine ripples and smooth waves between -roughness and roughness, or the upper half of a spheroid, half as
    high as wide, where it is higher: d / 4 sqrt(1 - t^2), where t is 0 at a stone's centre and 1 at its rim.
    """
    height = _compute_sediment_height(bed, x, y)
    for (at_x, at_y), diameter in zip(bed.stone_places(), bed.stone_diameters(), strict=True):
        squared = (np.square(x - at_x) + np.square(y - at_y)) / (0.5 * diameter) ** 2
        stone = 0.25 * diameter * np.sqrt(np.maximum(1 - squared, 0))
        height = np.where(squared < 1, np.maximum(height, stone), height)
    return height


def mesh_of(form: FreeForm) -> trimesh.Trimesh:
    return trimesh.Trimesh(*form.surface(), process=False)


def middles(mesh: trimesh.Trimesh) -> np.ndarray:
    """Middles of all faces and of their sides (4 F, 3), where facets deviate most from a smooth surface."""
    corners = mesh.triangles
    parts = [corners.mean(axis=1), *((corners[:, i] + corners[:, i - 1]) / 2 for i in range(3))]
    return np.concatenate(parts)


def test_a_sea_floor_has_ripples_and_stones():
    bed = Seabed(kind="seabed", roughness_mm=0.0, stones=0, ripple_pitch_mm=50.0, ripple_height_mm=5.0)
    x = np.linspace(-100, 100, 2001)
    np.testing.assert_allclose(seabed_height(bed, x, 0 * x), 2.5 * np.cos(2 * np.pi * x / 50.0), atol=1e-9)
    stony = Seabed(kind="seabed", ripple_height_mm=1.0, roughness_mm=0.5, stones=5, stone_diameter_mm=20.0)
    at = stony.stone_places()
    np.testing.assert_allclose(seabed_height(stony, *at.T), 5.0)
    mesh = mesh_of(stony)
    # The sediment and five stones, each a disc as topology has it.
    assert mesh.euler_number == 6 and mesh.face_normals[:, 2].max() < 0
    x, y, z = middles(mesh).T
    above = -z - seabed_height(stony, x, y)
    # Visible points agree with the formula or are below it: chords along both axes, at most twice 0.04 mm.
    assert above.max() < 0.08
    shown = above > -0.08
    nearest = np.min([np.hypot(x - u, y - v) for u, v in at], axis=0)
    assert shown[nearest > 10.0].all() and shown[nearest < 10.0].sum() > 1000


def test_stones_of_several_sizes_lie_between_the_smallest_and_the_largest():
    bed = Seabed(kind="seabed", width_mm=4000.0, height_mm=4000.0, stones=2000, stone_diameter_mm=80.0)
    assert (bed.stone_diameters() == 80.0).all()
    sizes = bed.model_copy(update={"smallest_stone_mm": 20.0}).stone_diameters()
    # The median of logarithms spread evenly over log 4 has a standard error of log 4 / (2 sqrt(2000)): six are 0.093.
    assert 20.0 <= sizes.min() < 21.0 and 79.0 < sizes.max() <= 80.0
    assert np.median(sizes) == pytest.approx(40.0, rel=0.1)
    at = bed.stone_places()[0]
    assert seabed_height(bed, *at) >= 20.0


WRONG = {"smallest_stone_mm 20 is more": {"smallest_stone_mm": 20.0}, "stone_diameter_mm": {"stone_diameter_mm": 400.0}}


@pytest.mark.parametrize("message", WRONG)
def test_sea_floors_that_cannot_be_are_refused(message):
    with pytest.raises(ValidationError, match=message):
        Seabed.model_validate({"kind": "seabed"} | WRONG[message])


def test_a_block_with_rounded_edges_is_a_box_moved_by_a_sphere():
    size, radius = np.array([30.0, 20.0, 10.0]), 1.5
    mesh = trimesh.Trimesh(*rounded_box(size, radius_mm=radius), process=True)
    assert mesh.is_watertight and mesh.is_winding_consistent
    a, b, c = size - 2 * radius
    # Steiner's formula; chords over a quarter of a turn in 24 parts lack 7e-4 of the rounded parts.
    rounded = np.pi * radius**2 * (a + b + c) + 4 / 3 * np.pi * radius**3
    volume = a * b * c + 2 * radius * (a * b + b * c + c * a) + rounded
    assert volume - 2e-3 * rounded < mesh.volume < volume
    # Every point of the surface has the distance of the radius from the inner box.
    beyond = np.maximum(np.abs(middles(mesh)) - (size / 2 - radius), 0)
    assert np.abs(np.linalg.norm(beyond, axis=1) - radius).max() < 1.2e-3 * radius


@pytest.mark.parametrize("hurst", [0.3, 0.7])
def test_heights_of_a_relief_have_the_described_spectrum(hurst):
    """Against the structure function of the spectral density (1 + q^2)^-(H + 3/2), by quadrature to the finest wave."""
    own = FinishProperties("diffuse", relief_mm=0.2, relief_length_mm=2.0, relief_exponent=hurst)
    found, side = [], 257
    for seed in range(2):
        surface = bowed_plate(np.array([-20.0, -20.0]), np.array([20.0, 20.0]), bow_mm=0.0, cells=1)
        vertices, _, uv = add_relief(surface, own, np.random.default_rng(seed))
        # A plate is displaced along z only, and its texture stays where it was.
        np.testing.assert_allclose(vertices[:, 0] / 40 + 0.5, uv[:, 0], atol=1e-9)
        place = vertices[:, :2] * 256 / 40
        regular = vertices[np.abs(place - np.round(place)).max(axis=1) < 1e-6]
        z = regular[np.lexsort(np.round(regular[:, :2].T, 6)), 2].reshape(side, side)
        steps = np.round(np.array([0.5, 1.0, 2.0]) * (side - 1) / 40).astype(int)
        found.append([z.var(), *(np.mean(np.square(z[k:] - z[:-k])) / 2 for k in steps)])
    # Facets of up to 2 sqrt(area / 150,000).
    number = np.linspace(0, math.pi * 2.0 / (2 * math.sqrt(40 * 40 / 150_000)), 20_000)[1:]
    power = number**2 * (1 + number**2) ** -(hurst + 1.5)
    lag = steps * 40 / (side - 1) / 2.0
    expected = [1.0, *(power @ (1 - np.sinc(number * each / math.pi)) / power.sum() for each in lag)]
    # Two plates of 20 x 20 patches have the variance to 5 %, by waves of several patches to 10 %: three of these.
    np.testing.assert_allclose(np.mean(found, axis=0), 0.04 * np.array(expected), rtol=0.3)


def test_slender_facets_of_a_relief_become_compact_ones():
    """A pipe of strips has as many vertices as other surfaces of its area; quarters of its triangles: 2.4 million."""
    around = np.linspace(0, 2 * np.pi, 360, endpoint=False)
    pipe = tube(np.array([-90.0, 90.0]), around, np.full((2, 360), 30.0))
    own = FinishProperties("diffuse", relief_mm=1e-9, relief_length_mm=5.0)
    vertices, faces = add_relief(pipe, own, np.random.default_rng(1))
    whole = trimesh.Trimesh(vertices, faces, process=False)
    assert 50_000 < len(vertices) < 300_000
    assert whole.area == pytest.approx(trimesh.Trimesh(*pipe, process=False).area, rel=1e-6)
    # A pipe with open ends: 360 edges at each end have one face, the others two.
    sides = np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)), axis=0, return_counts=True)[1]
    assert sorted(set(sides.tolist())) == [1, 2] and np.count_nonzero(sides == 1) == 720
    lengths = np.linalg.norm(np.diff(vertices[faces[:, [0, 1, 2, 0]]], axis=1), axis=2)
    assert lengths.max() < 2 * np.sqrt(whole.area / 150_000) + 1e-6


def test_a_relief_follows_normals_and_closes_its_surface():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=20.0)
    own = FinishProperties("diffuse", relief_mm=0.1, relief_length_mm=5.0)
    vertices, faces = add_relief((ball.vertices, ball.faces), own, np.random.default_rng(1))
    whole, radius = trimesh.Trimesh(vertices, faces, process=False), np.linalg.norm(vertices, axis=1)
    assert whole.is_watertight and whole.volume > 0
    # 50 independent patches have the rms to 10 %; facets of the ball lie up to 20 mm 2 (pi / 80)^2 / 2 within it.
    assert radius.std() == pytest.approx(0.1, rel=0.3)
    assert 19.9 < radius.mean() < 20.02
