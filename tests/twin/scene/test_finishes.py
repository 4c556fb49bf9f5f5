"""Finishes against the laws of reflection: energy, reciprocity, Fresnel; and surface properties of the objects hit."""

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.virtual_sensors import block, plate, scene_of
from twin.backend.arrays import to_jit
from twin.scene.description import Plate, Scene, load_scene
from twin.scene.finish import directional_albedo, finish_bsdf, iron_index
from twin.scene.objects import Objects, build_objects
from uwlts.errors import DescriptionError, RangeError

WATER = 1.3312
OPTICS = {"medium_index": WATER, "wavelength_nm": 635.0}
COSINES = np.array([0.1, 0.3, 0.5, 0.7, 0.9, 1.0])

FINISHES = [
    {"reflectance": 0.8},
    {"reflectance": 0.8, "finish": "painted"},
    {"reflectance": 1.0, "finish": "painted", "alpha": 0.1},
    {"reflectance": 0.5, "finish": "pvc"},
    {"reflectance": 1.0, "finish": "pvc", "alpha": 0.5},
    {"reflectance": 1.0, "finish": "metal"},
    {"reflectance": 0.6, "finish": "metal", "alpha": 0.1},
    {"reflectance": 0.1, "mirror": 0.9},
]


def words(finish: dict[str, object]) -> str:
    return " ".join(str(value) for value in finish.values())


def bsdf_of(finish: dict[str, object], **optics: float) -> mi.BSDF:
    thing = Plate.model_validate({"kind": "plate", "width_mm": 1.0, "height_mm": 1.0} | finish)
    return finish_bsdf(thing, **OPTICS | optics)


def evaluated(bsdf: mi.BSDF, towards: np.ndarray, light: np.ndarray) -> np.ndarray:
    """BSDF times cosine (N,) for unit directions (N, 3) towards viewer and light in the surface's frame."""
    si = dr.zeros(mi.SurfaceInteraction3f, len(towards))
    si.wi = mi.Vector3f(*(to_jit(column) for column in towards.T))
    return bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(*(to_jit(column) for column in light.T)))[0].numpy()


def tilted(cosine: np.ndarray | float, azimuth: np.ndarray | float = 0.0) -> np.ndarray:
    """Unit directions (N, 3) at angles to the normal."""
    cosine, azimuth = np.broadcast_arrays(cosine, azimuth)
    sine = np.sqrt(1 - cosine**2)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine], axis=-1).reshape(-1, 3)


def integrated(bsdf: mi.BSDF, cosine: float) -> float:
    """Directional albedo by Gauss-Legendre quadrature of the BSDF alone.

    The azimuth is pi t^3: seen at a grazing angle a gloss is narrow in azimuth, about twice alpha times the cosine.
    """
    nodes, weights = np.polynomial.legendre.leggauss(120)
    t, weight = (nodes + 1) / 2, weights / 2
    angle = np.pi / 2 * t
    light = tilted(np.cos(angle)[:, None], np.pi * t**3)
    values = evaluated(bsdf, np.repeat(tilted(cosine), len(light), axis=0), light).reshape(120, 120)
    return float(np.pi / 2 * (weight * np.sin(angle)) @ values @ (weight * 2 * np.pi * 3 * t**2))


def fresnel(index: complex, cosine: np.ndarray) -> np.ndarray:
    """Reflectance of unpolarised light at a smooth face of a relative index (Born and Wolf, section 1.5)."""
    inside = np.sqrt(index**2 - 1 + cosine**2 + 0j)
    across = (cosine - inside) / (cosine + inside)
    along = (index**2 * cosine - inside) / (index**2 * cosine + inside)
    return (np.abs(across) ** 2 + np.abs(along) ** 2) / 2


@pytest.mark.parametrize("finish", FINISHES, ids=words)
def test_in_a_white_furnace_no_finish_sends_back_more_than_it_receives(finish):
    bsdf = bsdf_of(finish)
    sampled, quadrature = directional_albedo(bsdf, COSINES), [integrated(bsdf, c) for c in COSINES]
    assert max(quadrature) < 1 + 1e-3
    # The lattice of samples is good to 1e-3; the quadrature has ten or more nodes over the narrowest lobe.
    np.testing.assert_allclose(sampled, quadrature, rtol=0, atol=1.5e-3)
    if "finish" not in finish:
        np.testing.assert_allclose(quadrature, finish["reflectance"], rtol=1e-5)


@pytest.mark.parametrize("finish", FINISHES, ids=words)
def test_every_finish_is_reciprocal(finish):
    random = np.random.default_rng(0)
    a, b = (tilted(random.uniform(0.1, 1.0, 500), random.uniform(0, 2 * np.pi, 500)) for _ in range(2))
    bsdf = bsdf_of(finish)
    there, back = evaluated(bsdf, a, b) / b[:, 2], evaluated(bsdf, b, a) / a[:, 2]
    assert there.min() > 0
    # 32 bits, and in the narrowest lobe (alpha 0.1) the half vector's rounding of 1e-7 over alpha squared.
    np.testing.assert_allclose(there, back, rtol=1e-3)


def test_smooth_steel_reflects_as_fresnel_says_relative_to_the_medium():
    for index in (1.0, WATER):
        # A lobe of alpha 0.02 averages Fresnel's formula, flat but at grazing angles, over some 2 deg, and masking
        # takes about alpha squared times tan squared.
        steel = bsdf_of({"reflectance": 1.0, "finish": "metal", "alpha": 0.02}, medium_index=index)
        cosine = np.array([0.5, 0.7, 0.9, 1.0])
        expected = fresnel(iron_index(wavelength_nm=635.0) / index, cosine)
        np.testing.assert_allclose(directional_albedo(steel, cosine), expected, rtol=0, atol=3e-3)
    assert fresnel(iron_index(wavelength_nm=635.0), np.ones(1))[0] == pytest.approx(0.53, abs=0.01)


def test_rough_steel_loses_the_light_that_would_be_reflected_twice():
    # Single scattering only: remaining fractions of the albedo of smooth steel at normal incidence, to detect changes
    # in Mitsuba's model.
    smooth, usual, rough = (
        directional_albedo(bsdf_of({"reflectance": 1.0, "finish": "metal", "alpha": alpha}), np.ones(1))[0]
        for alpha in (0.02, 0.3, 1.0)
    )
    assert 0.80 < usual / smooth < 0.95
    assert 0.25 < rough / smooth < 0.40


def test_a_coat_shines_less_under_water_than_in_air():
    black = {"reflectance": 0.0, "finish": "painted", "alpha": 0.02}
    for index in (1.0, WATER):
        expected = fresnel(1.50 / index, np.ones(1))[0]
        assert directional_albedo(bsdf_of(black, medium_index=index), np.ones(1))[0] == pytest.approx(
            expected, rel=0.02
        )


def test_a_white_body_under_a_smooth_coat_keeps_nothing():
    # Light not reflected by the coat leaves a white body again; Mitsuba's table of rough transmittance is accurate to
    # 1 %.
    white = bsdf_of({"reflectance": 1.0, "finish": "painted", "alpha": 0.02})
    np.testing.assert_allclose(directional_albedo(white, np.array([0.3, 0.6, 1.0])), 1.0, rtol=0, atol=0.015)


def test_the_medium_may_have_the_coats_index():
    same = bsdf_of({"reflectance": 0.5, "finish": "painted"}, medium_index=1.499)
    assert 0.35 < directional_albedo(same, np.ones(1))[0] <= 0.5


@pytest.mark.parametrize("wavelength", [390.0, 710.0])
def test_steel_outside_the_table_is_refused(wavelength):
    with pytest.raises(RangeError, match=r"Johnson and Christy \(1974\) is valid from 397 to 704"):
        iron_index(wavelength_nm=wavelength)


def test_iron_lies_between_the_tables_neighbours():
    # Johnson and Christy: 2.88 + 3.05 i at 617 nm, 2.92 + 3.10 i at 659 nm; 635 nm is 3/7 of the way.
    assert iron_index(wavelength_nm=635.0) == pytest.approx(2.88 + 0.04 * 3 / 7 + 1j * (3.05 + 0.05 * 3 / 7))


# --- surface properties ---------------------------------------------------------------------------------------------


def built(scene: Scene, **changes: object) -> Objects:
    return build_objects(scene, **OPTICS | changes)


def hit(objects: Objects, start: np.ndarray, towards: np.ndarray) -> mi.SurfaceInteraction3f:
    """Intersect rays (N, 3) with the objects."""
    start, towards = np.broadcast_arrays(np.asarray(start, float), np.asarray(towards, float))
    o, d = (mi.Vector3f(*(to_jit(np.atleast_1d(c)) for c in v.T)) for v in (start, towards))
    return objects.scene.ray_intersect(mi.Ray3f(mi.Point3f(o), d))


def row_of(*finishes: dict[str, object]) -> Scene:
    """Return plates in a row along X with a spacing of 10 mm."""
    return scene_of(*(plate(side=8.0, x=10.0 * i) | finish for i, finish in enumerate(finishes)))


def from_above(count: int, slope: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Rays to the middles of a row's plates."""
    towards = np.array([slope, 0.0, 1.0]) / np.hypot(1, slope)
    middle = np.stack([10.0 * np.arange(count), np.zeros(count), np.zeros(count)], axis=1)
    return middle - 50.0 * towards, towards


def told(objects: Objects, si: mi.SurfaceInteraction3f) -> np.ndarray:
    """Mirror share, polarisation and rms height of places, (3, N)."""
    return np.stack([f(si).numpy() for f in (objects.mirror_share, objects.polarisation, objects.roughness_um)])


def test_every_place_has_the_facts_of_its_own_object_whatever_scenes_there_are():
    finishes = [{"reflectance": 0.1, "mirror": 0.1 * i, "roughness_um": 1.0 + i} for i in range(6)]
    first, second = built(row_of(*finishes)), built(row_of({"finish": "metal"}, *finishes[::-1]))
    start, towards = from_above(8)
    mirror = 0.1 * np.arange(6)
    expected = np.array([[*mirror, 0, 0], [0, 1, 1, 1, 1, 1, 0, 0], [1, 2, 3, 4, 5, 6, 0, 0]])
    np.testing.assert_allclose(told(first, hit(first, start, towards)), expected, rtol=1e-6)
    del first
    third = built(row_of({"finish": "painted"}))
    np.testing.assert_allclose(told(third, hit(third, start[:2], towards)), [[0, 0], [0, 0], [5, 0]])
    expected = np.array([[0, *mirror[::-1], 0], [1, 1, 1, 1, 1, 1, 0, 0], [1, 6, 5, 4, 3, 2, 1, 0]])
    np.testing.assert_allclose(told(second, hit(second, start, towards)), expected, rtol=1e-6)


def test_blocks_of_equal_reflectance_stay_apart():
    things = [block((8.0, 8.0, 8.0), (10.0 * i, 0.0, 4.0), reflectance=0.3) | {"mirror": 0.2 * i} for i in range(3)]
    objects = built(scene_of(*things))
    np.testing.assert_allclose(told(objects, hit(objects, *from_above(3)))[0], [0, 0.2, 0.4], rtol=1e-6)


def test_only_the_front_is_a_mirror():
    objects = built(row_of({"reflectance": 0.1, "mirror": 0.8}))
    assert told(objects, hit(objects, [[0.0, 0.0, 50.0]], [0.0, 0.0, -1.0]))[0] == 0


def test_a_mirror_scatters_only_its_diffuse_part():
    objects = built(row_of({"reflectance": 0.05, "mirror": 0.9}))
    si = hit(objects, *from_above(1, 0.5))
    reflected = si.bsdf().eval(mi.BSDFContext(), si, mi.reflect(si.wi))[0].numpy()
    np.testing.assert_allclose(reflected * np.pi / si.wi.z.numpy(), 0.05, rtol=1e-5)
    np.testing.assert_allclose(objects.albedo(si).numpy(), 0.05, rtol=1e-5)


def test_mirror_faces_lie_where_rays_meet_the_objects():
    pose = {"position_mm": (3.0, -4.0, 5.0), "rotation_deg": (20.0, -30.0, 40.0)}
    things = {
        "plate": {"kind": "plate", "width_mm": 30.0, "height_mm": 20.0},
        "block": {"kind": "block", "size_mm": (30.0, 20.0, 10.0)},
    }
    random = np.random.default_rng(0)
    for kind, thing in things.items():
        objects = built(scene_of(thing | pose | {"reflectance": 0.1, "mirror": 0.7}))
        assert len(objects.mirrors) == {"plate": 1, "block": 6}[kind]
        towards = random.normal(size=(20000, 3))
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        start = np.array(pose["position_mm"]) + random.uniform(-10, 10, (20000, 3)) - 60 * towards
        si = hit(objects, start, towards)
        share, n = objects.mirror_share(si).numpy(), si.n.numpy().T
        p, seen = si.p.numpy().T, np.zeros(20000, int)
        for face in objects.mirrors:
            np.testing.assert_allclose(face.pose[:3, :3].T @ face.pose[:3, :3], np.eye(3), atol=1e-12)
            assert np.linalg.det(face.pose[:3, :3]) == pytest.approx(1)
            local = (p - face.pose[:3, 3]) @ face.pose[:3, :3]
            on = (n @ face.pose[:3, 2] > 0.99) & (share > 0)
            assert on.sum() > 500
            # 32 bits: a coordinate of 60 mm is known to 4e-6 mm.
            np.testing.assert_allclose(local[on, 2], 0, atol=1e-4)
            reach = np.abs(local[on, :2]).max(axis=0)
            assert (reach < face.half_size_mm + 1e-4).all()
            assert (reach > 0.95 * face.half_size_mm).all()
            assert face.share == 0.7
            seen += on
        np.testing.assert_array_equal(seen, share > 0)


def test_the_albedo_under_an_even_sky_is_that_of_the_furnace():
    objects = built(row_of(*FINISHES))
    for slope in (0.0, 0.4, 1.3, 4.0):
        si = hit(objects, *from_above(len(FINISHES), slope))
        cosine = 1 / np.hypot(1, slope)
        expected = [integrated(bsdf_of(finish), cosine) for finish in FINISHES]
        # Samples are good to 1e-3; between the table's 65 cosines the albedo bends by less.
        np.testing.assert_allclose(objects.albedo(si).numpy(), expected, rtol=0, atol=2.5e-3)
    away = hit(objects, *from_above(len(FINISHES) + 2))
    assert (objects.albedo(away).numpy()[-2:] == 0).all()
    behind = hit(objects, [[0.0, 0.0, 50.0]], [0.0, 0.0, -1.0])
    assert behind.is_valid().numpy().all() and (objects.albedo(behind).numpy() == 0).all()


def test_without_gloss_everything_is_diffuse():
    objects = built(row_of(*FINISHES), gloss=False)
    assert objects.mirrors == ()
    start, towards = from_above(len(FINISHES), 1.0)
    si = hit(objects, start, towards)
    metal = fresnel(iron_index(wavelength_nm=635.0) / WATER, np.ones(1))[0]
    expected = [f["reflectance"] * (metal if f.get("finish") == "metal" else 1) for f in FINISHES]
    np.testing.assert_allclose(objects.albedo(si).numpy(), expected, rtol=1e-5)
    assert (objects.mirror_share(si).numpy() == 0).all()
    for light in (tilted(0.9), tilted(0.2, 1.0)):
        value = si.bsdf().eval(mi.BSDFContext(), si, mi.Vector3f(*map(float, light[0])))[0].numpy()
        np.testing.assert_allclose(value, np.array(expected) * light[0, 2] / np.pi, rtol=1e-5)


def test_facts_and_albedo_compile_once():
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    try:
        objects = built(row_of(*FINISHES))

        def launch(count: int) -> int:
            si = hit(objects, *from_above(len(FINISHES), 0.01 * count))
            dr.kernel_history()
            dr.eval(objects.mirror_share(si), objects.polarisation(si), objects.roughness_um(si), objects.albedo(si))
            kernels = dr.kernel_history((dr.KernelType.JIT,))
            assert kernels
            return sum(not kernel["cache_hit"] for kernel in kernels)

        launch(0)
        assert sum(launch(count) for count in range(1, 6)) == 0
    finally:
        dr.set_flag(dr.JitFlag.KernelHistory, False)
        dr.kernel_history()


# --- textures -------------------------------------------------------------------------------------------------------


@pytest.fixture
def picture(tmp_path):
    """A picture of 2 rows and 3 columns, and its grey values."""
    grey = np.array([[10, 60, 110], [160, 210, 255]], np.uint8)
    assert cv2.imwrite(str(tmp_path / "grey.png"), grey)
    return tmp_path / "grey.png", grey / 255


@pytest.mark.parametrize(
    "finish", [{}, {"finish": "painted"}, {"finish": "metal"}], ids=["diffuse", "painted", "metal"]
)
def test_a_texture_multiplies_the_reflectance_and_lies_on_a_plate_as_the_sensor_sees_it(picture, finish):
    path, grey = picture
    objects = built(scene_of(plate(side=30.0) | {"reflectance": 0.7, "texture": str(path)} | finish))
    # The camera looks along +z with x to the right and y down: texels' centres in the picture's order.
    x, y = np.meshgrid((np.arange(3) - 1) * 10.0, (np.arange(2) - 0.5) * 15.0)
    si = hit(objects, np.stack([x.ravel(), y.ravel(), np.full(6, -40.0)], axis=1), [0.0, 0.0, 1.0])
    expected = [
        directional_albedo(bsdf_of(finish | {"reflectance": 0.7 * value}), np.ones(1))[0] for value in grey.ravel()
    ]
    # Both albedos come from sampling good to 1e-3.
    np.testing.assert_allclose(objects.albedo(si).numpy(), expected, rtol=0, atol=2e-3)
    assert np.ptp(expected) > 0.2


@pytest.mark.parametrize("thing", [{"kind": "sphere"}, {"kind": "pipe", "length_mm": 40.0}], ids=["sphere", "pipe"])
def test_a_texture_follows_a_round_shapes_own_coordinates(tmp_path, thing):
    # Grey increases along a wide picture, so that the value determines u.
    ramp = np.tile(np.arange(256, dtype=np.uint8), (4, 1))
    assert cv2.imwrite(str(tmp_path / "ramp.png"), ramp)
    thing = thing | {"diameter_mm": 30.0, "reflectance": 0.5, "texture": str(tmp_path / "ramp.png")}
    objects = built(scene_of(thing))
    random = np.random.default_rng(0)
    start = np.concatenate([random.uniform(-10, 10, (500, 2)), np.full((500, 1), -40.0)], axis=1)
    si = hit(objects, start, [0.0, 0.0, 1.0])
    u, albedo = si.uv.numpy()[0], objects.albedo(si).numpy()
    inside = (u > 0.01) & (u < 0.99)
    assert inside.sum() > 400 and np.ptp(u[inside]) > 0.2
    np.testing.assert_allclose(albedo[inside], 0.5 * (256 * u[inside] - 0.5) / 255, rtol=0, atol=1e-4)


QUAD = "v -15 -15 0\nv 15 -15 0\nv 15 15 0\nv -15 15 0\n{}"


def test_a_mesh_takes_its_texture_by_its_own_coordinates(tmp_path, picture):
    path, grey = picture
    # Coordinates as usual in OBJ files: v upwards from the picture's last row; here +y is up.
    (tmp_path / "quad.obj").write_text(QUAD.format("vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"))
    thing = {"kind": "mesh", "path": str(tmp_path / "quad.obj"), "texture": str(path), "reflectance": 1.0}
    objects = built(scene_of(thing))
    x, y = np.meshgrid((np.arange(3) - 1) * 10.0, (0.5 - np.arange(2)) * 15.0)
    # A mesh shows either side.
    for side in (-1.0, 1.0):
        si = hit(objects, np.stack([x.ravel(), y.ravel(), np.full(6, 40.0 * side)], axis=1), [0.0, 0.0, -side])
        np.testing.assert_allclose(objects.albedo(si).numpy(), grey.ravel(), rtol=0, atol=1e-4)


def test_a_texture_on_a_mesh_without_coordinates_is_refused(tmp_path, picture):
    (tmp_path / "quad.obj").write_text(QUAD.format("f 1 2 3\nf 1 3 4\n"))
    scene = scene_of({"kind": "mesh", "path": str(tmp_path / "quad.obj"), "texture": str(picture[0])})
    with pytest.raises(DescriptionError, match=r"quad\.obj has no texture coordinates for .*grey\.png"):
        built(scene)


def test_a_missing_or_foreign_texture_is_refused(tmp_path):
    scene = scene_of(plate() | {"texture": str(tmp_path / "grey.png")})
    with pytest.raises(DescriptionError, match=r"texture: no image at .*grey\.png"):
        built(scene)
    for content in (b"", b"hello", b"\x89PNG\r\n\x1a\n" + b"\x00" * 40):
        (tmp_path / "grey.png").write_bytes(content)
        with pytest.raises(DescriptionError, match=r"grey\.png is (no|a) PNG"):
            built(scene)
    assert cv2.imwrite(str(tmp_path / "float.tif"), np.full((4, 4), 1.5, np.float32))
    with pytest.raises(DescriptionError, match=r"float\.tif holds values of float32"):
        built(scene_of(plate() | {"texture": str(tmp_path / "float.tif")}))


def test_deep_and_coloured_pictures_are_read_linearly(tmp_path):
    pictures = {
        "deep.png": (np.full((4, 4), 40000, np.uint16), 40000 / 65535),
        "coloured.png": (np.full((4, 4, 3), 90, np.uint8), 90 / 255),
    }
    for name, (pixels, expected) in pictures.items():
        assert cv2.imwrite(str(tmp_path / name), pixels)
        objects = built(row_of({"reflectance": 1.0, "texture": str(tmp_path / name)}))
        assert objects.albedo(hit(objects, *from_above(1))).numpy()[0] == pytest.approx(expected, rel=1e-5)


def test_a_circle_plate_may_be_glossy():
    thing = load_scene("target").objects[0]
    scene = scene_of(thing.model_dump() | {"finish": "painted"})
    objects = built(scene)
    start = np.array([[thing.spacing_x_mm * 3, 0.0, -50.0], [thing.spacing_x_mm * 3.5, 0.0, -50.0]])
    found = objects.albedo(hit(objects, start, [0.0, 0.0, 1.0])).numpy()
    bodies = (thing.circle_reflectance, thing.background_reflectance())
    expected = [directional_albedo(bsdf_of({"finish": "painted", "reflectance": b}), np.ones(1))[0] for b in bodies]
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-3)
