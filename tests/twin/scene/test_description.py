"""Scene descriptions: all shipped ones are valid, and every mistake is rejected with its name.

The descriptions of sensors are tested in `tests.uwlts.model.test_library`.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.virtual_sensors import altered, plate, scene_of
from twin.light.renderer import Renderer
from twin.recording.sensor_simulator import check_scene
from twin.rendering_options import Options
from twin.scene.description import Scene, load_scene, medium_of
from twin.scene.objects import Objects, build_objects
from twin.scene.platforms import Motion
from twin.scene.scene_object import Pose
from uwlts.errors import DescriptionError
from uwlts.model.library import library_folder, list_names, load_sensor

BUILT_SLOWLY = "vehicle-pass"
"""A sea floor of 20 m, whose mesh takes ten seconds."""
PLACES = [
    pytest.param(scene, place, marks=[pytest.mark.slow] if scene == BUILT_SLOWLY else [])
    for scene in list_names()
    for place in load_scene(scene).placements
]


def built(scene: Scene) -> Objects:
    return build_objects(scene, medium_index=1.33, wavelength_nm=635.0)


def test_the_library_is_not_empty():
    assert {"plane", "spheres", "step", "pipe", "head", "weld", "target"} <= set(list_names())
    assert len(PLACES) > 15


@pytest.mark.parametrize(("name", "place"), PLACES)
def test_every_shipped_scene_stands_before_the_thesis_sensor(thesis, name, place):
    scene = load_scene(name, placement=place)
    assert len(scene.object_poses()) == len(scene.objects)
    window = {"mounted": scene.window_mounted}
    sensor = altered(thesis, {"camera": {"window": window}})
    renderer = Renderer(sensor, medium_of(sensor, scene), scene)
    assert renderer.objects.scene.bbox().valid()
    check_scene(renderer, scene)


def written(folder, text: str, *, name: str = "sensor.toml"):
    """Path of a description in a folder of its own."""
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_a_laser_may_be_placed_by_origin_and_axis_instead(tmp_path, thesis):
    text = (library_folder() / "sensors" / "thesis.toml").read_text(encoding="utf-8")
    placed = text.replace("baseline_mm = 265.0", "origin_mm = [0.0, -265.0, 0.0]")
    placed = placed.replace("triangulation_angle_deg = 35.0", "axis = [0.0, 1.0, 1.4281480067421146]")
    sensor = load_sensor(written(tmp_path, placed))
    scene = scene_of(plate())
    views = [Renderer(which, which.media["water"], scene).design for which in (sensor, thesis)]
    np.testing.assert_allclose(
        [views[0].standoff_mm, views[0].line_length_mm], [views[1].standoff_mm, views[1].line_length_mm]
    )


PLATE = "title = 't'\n[[objects]]\nkind = 'plate'\nwidth_mm = 5.0\nheight_mm = 5.0\n"
BLOCK = "title = 't'\n[[objects]]\nkind = 'block'\nsize_mm = [10.0, 10.0, 10.0]\n"
HEAD = "title = 't'\n[[objects]]\nkind = 'head'\n"
WELD = "title = 't'\n[[objects]]\nkind = 'weld'\n"

# Mistake, and expected part of the message.
BAD_SCENES = {
    "no objects": ("title = 't'\nobjects = []", r"objects: .*at least 1"),
    "objects as a table": ("title = 't'\n[objects]\nkind = 'plate'", r"\[\[objects\]\]"),
    "unknown object": ("title = 't'\n[[objects]]\nkind = 'cube'", r"objects\.0: .*'cube'"),
    "wrong unit": (
        "title = 't'\n[[objects]]\nkind = 'sphere'\ndiameter_m = 0.05",
        r"objects\.0\.sphere\.diameter_m: unknown key.* diameter_mm\)",
    ),
    "reflectance": (
        "base = 'plane'\n[[objects]]\nkind = 'sphere'\ndiameter_mm = 5.0\nreflectance = 1.2",
        r"reflectance: .*1\.2",
    ),
    "placement": ("base = 'plane'\nplacement = 'nearby'", r"placement 'nearby' is not one of near, standoff, far"),
    "direction": (
        "base = 'plane'\n[motion]\ndirection = [0.0, 0.0, 0.0]",
        r"motion: direction \(0\.0, 0\.0, 0\.0\) has no length",
    ),
    "no light": ("base = 'plane'\n[motion]\nlights = []", r"motion: lights is empty"),
    "falling bracket": ("base = 'plane'\n[motion]\nbracket = [1, 16, 4]", r"motion\.bracket: .*such as \[1, 4, 16\]"),
    "bracket in motion": ("base = 'plane'\n[motion]\nbracket = [1, 4]\nspeed_mm_per_s = 5", r"motion: a moving stage"),
    "unknown light": ("base = 'plane'\n[motion]\nlights = ['sun']", r"motion\.lights\.0: .*'sun'"),
    "no frames": ("base = 'plane'\n[motion]\ncount = 0", r"motion\.count: .*found 0"),
    "step not a number": ("base = 'plane'\n[motion]\nstep_mm = nan", r"motion\.step_mm: .*finite"),
    "backwards in time": ("base = 'plane'\n[motion]\nspeed_mm_per_s = -1.0", r"motion\.speed_mm_per_s: .*found -1"),
    "unknown finish": (PLATE + "finish = 'velvet'", r"finish: .*'diffuse', 'painted', .*'marine-growth'.*'velvet'"),
    "too smooth": (PLATE + "finish = 'metal'\nalpha = 0.001", r"alpha: .*0\.02.*found 0\.001"),
    "rough gloss of none": (PLATE + "alpha = 0.2", r"alpha 0\.2 .* finish is 'diffuse': omit alpha"),
    "white and uneven": (PLATE + "mottle = 0.3", r"reflectance 0\.8 with mottle 0\.3 .* lose 4\.\d % .*reduce"),
    "two textures": (
        PLATE + "finish = 'concrete'\ntexture = 'wall.png'",
        r"texture .*wall\.png and mottle 0\.2: use one of them, or mottle = 0",
    ),
    "translucent steel": (PLATE + "finish = 'metal'\nmean_free_path_mm = 0.1", r"mean_free_path_mm 0\.1 in a metal"),
    "all edge": (BLOCK + "edge_radius_mm = 5.0", r"edge_radius_mm 5 is half of the least side or more"),
    "round mirror block": (
        BLOCK + "edge_radius_mm = 1.0\nreflectance = 0.1\nmirror = 0.5",
        r"mirror 0\.5 on a block with rounded edges",
    ),
    "no length": (PLATE + "reflectance = 0.2\nmottle = 0.3\nmottle_mm = 0.0", r"mottle_mm.*found 0"),
    "rusted print": (
        "base = 'target'\n[[objects]]\nkind = 'target_plate'\nfinish = 'rusted-steel'",
        r"mottle 0\.3 .*printed",
    ),
    "negative height": (PLATE + "roughness_um = -1.0", r"roughness_um: .*found -1"),
    "more than all light": (PLATE + "mirror = 0.5", r"reflectance 0\.8 and mirror 0\.5 add up to more than 1"),
    "coated mirror": (PLATE + "reflectance = 0.1\nfinish = 'pvc'\nmirror = 0.5", r"mirror 0\.5 under a coat"),
    "round mirror": (
        "title = 't'\n[[objects]]\nkind = 'sphere'\ndiameter_mm = 5.0\nmirror = 0.1",
        r"objects\.0\.sphere\.mirror: unknown key",
    ),
    "texture not a path": (PLATE + "texture = 3", r"texture: .*string.*found 3"),
    "textured head": (HEAD + "texture = 'skin.png'", r"texture .*skin\.png on a surface without uv coordinates"),
    "flat head": (HEAD + "height_mm = 0.0", r"objects\.0\.head\.height_mm: .*found 0"),
    "headless head": (HEAD + "diameter_mm = 90.0", r"objects\.0\.head\.diameter_mm: unknown key"),
    "textured weld": (WELD + "texture = 'rust.png'", r"texture .*rust\.png on a surface without uv coordinates"),
    "slanting weld": (WELD + "along = 'z'", r"along: .*'x' or 'y'.*found 'z'"),
    "beads that touch": (WELD + "spacing_mm = 11.0", r"spacing_mm 11 lets beads touch that may be 11\.8 mm wide"),
    "beads beyond the plate": (
        WELD + "beads = 8",
        r"56 mm along x and 137\.8 mm together across it do not fit on.*80 x 120",
    ),
    "a bead too long": (WELD + "length_mm = 90.0", r"90 mm along x .*do not fit on plate_mm 80 x 120"),
    "beads across the plate": (
        WELD + "along = 'y'\nlength_mm = 90.0\nspacing_mm = 36.0",
        r"along y and 83\.8 mm .*not fit",
    ),
    "a short bead": (WELD + "length_mm = 9.0", r"length_mm 9 is shorter than its width_mm 10"),
    "deep ripples": (WELD + "ripple_height_mm = 4.0", r"ripple_height_mm 4 lets troughs dip .* bead of height_mm 2"),
    "wild beads": (WELD + "irregularity = 0.5", r"irregularity: .*0\.3.*found 0\.5"),
}


@pytest.mark.parametrize("mistake", BAD_SCENES)
def test_a_mistake_in_a_scene_is_refused_by_name(tmp_path, mistake):
    text, message = BAD_SCENES[mistake]
    with pytest.raises(DescriptionError, match=message):
        load_scene(written(tmp_path, text))


def test_a_placement_may_be_chosen_and_must_be_known():
    assert load_scene("plane", placement="far").placement == "far"
    with pytest.raises(DescriptionError, match="placement 'further' is not one of"):
        load_scene("plane", placement="further")


def test_a_medium_that_the_sensor_does_not_know_is_refused(thesis):
    with pytest.raises(DescriptionError, match="'thesis' knows the media air, water, not 'oil'"):
        medium_of(thesis, scene_of(plate(), medium="oil"))


def test_the_water_of_a_scene_replaces_that_of_the_sensor(thesis):
    own = thesis.medium("water")
    clear, turbid, named = (medium_of(thesis, scene_of(plate(), water=water)) for water in (None, 1.5, "jerlov-III"))
    assert clear == own and turbid.turbidity == 1.5 and named.water == "jerlov-III"
    for medium in (turbid, named):
        assert (medium.kind, medium.temperature_c, medium.salinity_g_kg) == (
            own.kind,
            own.temperature_c,
            own.salinity_g_kg,
        )


MESH = "title = 't'\n[[objects]]\nkind = 'mesh'\npath = 'part.stl'\n"


def test_a_mesh_that_is_missing_or_damaged_is_refused(tmp_path):
    scene = load_scene(written(tmp_path, MESH))
    with pytest.raises(DescriptionError, match=rf"no mesh at {tmp_path}/part\.stl"):
        built(scene)
    for content in (b"", b"solid nothing\nendsolid nothing\n", b"\x00" * 200):
        (tmp_path / "part.stl").write_bytes(content)
        with pytest.raises(DescriptionError, match=r"part\.stl"):
            built(scene)


def test_paths_of_meshes_and_textures_start_at_the_scenes_folder(tmp_path):
    scene = load_scene(written(tmp_path, MESH + "texture = 'skin/grey.png'\n"))
    assert (scene.objects[0].path, scene.objects[0].texture) == (f"{tmp_path}/part.stl", f"{tmp_path}/skin/grey.png")


def test_a_circle_plate_takes_no_texture():
    plate = load_scene("target").objects[0].model_dump()
    with pytest.raises(ValueError, match="texture grey.png on a plate with a printed pattern"):
        scene_of(plate | {"texture": "grey.png"})


def test_what_a_finish_does_not_say_is_usual_for_it():
    plain, steel, mirror = scene_of(
        plate(), plate() | {"finish": "metal"}, plate(reflectance=0.1) | {"mirror": 0.8, "roughness_um": 0.01}
    ).objects
    assert (plain.finish, plain.mirror_share(), plain.polarisation(), plain.finish_properties().roughness_um) == (
        "diffuse",
        0,
        0,
        5,
    )
    assert (steel.finish_properties().alpha, steel.mirror_share(), steel.polarisation()) == (0.3, 0, 1)
    assert (mirror.mirror_share(), mirror.polarisation(), mirror.finish_properties().roughness_um) == (0.8, 1, 0.01)
    assert Motion().speed_mm_per_s == 0


@pytest.mark.parametrize("wrong", [{"spp": 0}, {"spp": 70000}, {"seed": -1}])
def test_options_outside_their_range_are_refused(wrong):
    ((key, value),) = wrong.items()
    with pytest.raises(DescriptionError, match=f"{key} is {value}"):
        Options(**wrong)


def test_a_pose_turns_about_the_scenes_x_then_y_then_z():
    pose = Pose(position_mm=(1.0, 2.0, 3.0), rotation_deg=(20.0, -30.0, 50.0)).matrix()
    about_x, about_y, about_z = (
        Rotation.from_rotvec(np.radians(angle) * axis).as_matrix()
        for angle, axis in zip((20, -30, 50), np.eye(3), strict=True)
    )
    np.testing.assert_allclose(pose[:3, :3], about_z @ about_y @ about_x, atol=1e-15)
    np.testing.assert_array_equal(pose[:, 3], [1, 2, 3, 1])


def test_placements_carry_all_objects_together():
    far = {"far": {"position_mm": (0.0, 0.0, 80.0), "rotation_deg": (0.0, 0.0, 90.0)}}
    scene = scene_of(plate(1.0, x=10.0), plate(2.0), placements=far, placement="far")
    first, second = scene.object_poses()
    np.testing.assert_allclose(first[:3, 3], [0, 10, 81], atol=1e-12)
    np.testing.assert_allclose(second[:3, 3], [0, 0, 82], atol=1e-12)


def test_a_scan_takes_its_lights_in_turn_at_every_position():
    motion = Motion(start_mm=-2.0, step_mm=1.5, count=3, direction=(0.0, 3.0, 4.0), lights=("lamp", "laser"))
    assert [(shot.stage_mm, shot.light) for shot in motion.shots()] == [
        (-2.0, "lamp"),
        (-2.0, "laser"),
        (-0.5, "lamp"),
        (-0.5, "laser"),
        (1.0, "lamp"),
        (1.0, "laser"),
    ]
    np.testing.assert_allclose(motion.unit_direction(), [0, 0.6, 0.8])
    assert motion.recorded_direction() == pytest.approx((0.0, 0.6, 0.8))
    assert Motion(direction=(1.0, 0.01, 0.0), nominal_direction=(2.0, 0.0, 0.0)).recorded_direction() == (1.0, 0.0, 0.0)


def test_descriptions_are_frozen_and_survive_json(thesis):
    with pytest.raises(ValueError, match="frozen"):
        thesis.name = "other"
    scene = load_scene("target")
    assert Scene.model_validate_json(scene.model_dump_json()) == scene
