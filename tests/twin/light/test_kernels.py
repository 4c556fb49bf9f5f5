"""Frames after the first reuse its kernels, for any sensor pose and number of lit pixels.

Other sensors and waters do too: a design study does not recompile kernels for each design.
"""

import drjit as dr
import numpy as np
import pytest

from tests.virtual_sensors import altered, clear, plate, scene_of, sensor_at
from twin.datasets.data_set import DataSetDescription, load_description
from twin.datasets.generation import draw_scene
from twin.datasets.labels import make_labels
from twin.light.pose import SensorPose
from twin.light.renderer import Renderer
from twin.recording.frame_truth import find_true_stripe
from twin.recording.sensor_simulator import SensorSimulator
from twin.scene.description import load_scene
from uwlts.model.sensor import Medium, Sensor

SMALL = {"camera": {"width_px": 320, "height_px": 256, "pixel_size_um": 21.2}}


@pytest.fixture
def new_kernels():
    """Counts kernels launched since the last call that were compiled or read from disk, not found in memory.

    None is in memory at first, whatever other tests have left.
    """
    dr.flush_kernel_cache()
    dr.kernel_history()
    dr.set_flag(dr.JitFlag.KernelHistory, True)

    def count() -> tuple[int, int]:
        launched = dr.kernel_history((dr.KernelType.JIT,))
        return len(launched), sum(not kernel["cache_hit"] or bool(kernel["cache_disk"]) for kernel in launched)

    yield count
    dr.set_flag(dr.JitFlag.KernelHistory, False)
    dr.kernel_history()


def sphere() -> dict[str, object]:
    return {"kind": "sphere", "diameter_mm": 50.0, "position_mm": (0.0, 10.0, 0.0)}


@pytest.mark.slow
def test_a_laser_scan_compiles_nothing_after_its_first_frame(thesis, new_kernels):
    sensor = altered(thesis, SMALL)
    renderer = Renderer(sensor, clear(0.3, 0.5), scene_of(sphere(), plate(60.0, side=150.0, x=40.0)))
    new_kernels()

    def frame(index: int, pose: np.ndarray) -> int:
        image = renderer.laser_frame(pose, spp=4 + index % 2).irradiance()
        find_true_stripe(renderer, pose)
        return len(renderer.locator.lit_pixels(SensorPose(pose))[0]) + 0 * len(image)

    for index in range(2):
        frame(index, sensor_at(x=0.5))
    assert new_kernels()[1] >= 4, "the first frames must compile something, or nothing is tested"
    lit = {frame(index, sensor_at(3.0 * index, x=2.7 * index - 40.0)) for index in range(2, 30)}
    assert len(lit) > 10, "the number of lit pixels changes"
    launched, new = new_kernels()
    assert launched > 100
    assert new == 0
    assert renderer.laser_frame(sensor_at(x=500.0), spp=4).irradiance().max() >= 0, "a frame with nothing in view"
    assert new_kernels()[1] == 0


def test_lamp_images_compile_nothing_after_the_first(thesis, new_kernels):
    renderer = Renderer(altered(thesis, SMALL), clear(), load_scene("target"))
    new_kernels()
    renderer.irradiance("lamp", sensor_at(), spp=4)
    assert new_kernels()[1] >= 2
    for index in range(8):
        renderer.irradiance("lamp", sensor_at(-15.0 * index, x=index), spp=4)
    launched, new = new_kernels()
    assert launched >= 16
    assert new == 0


OTHER = {
    "camera": {
        "width_px": 400,
        "height_px": 240,
        "pixel_size_um": 19.0,
        "focal_length_mm": 14.1,
        "f_number": 6.3,
        "window": {"distance_mm": 33.0, "thickness_mm": 4.2, "glass": 1.49},
    },
    "laser": {
        "baseline_mm": 171.0,
        "triangulation_angle_deg": 33.0,
        "fan_angle_deg": 24.0,
        "power_mw": 71.0,
        "waist_radius_mm": 0.081,
    },
}
"""Values that differ between designs; features that only one design has, such as distortion, need separate kernels."""


def test_another_sensor_in_other_water_compiles_nothing(thesis, new_kernels):
    def frames(sensor: Sensor, medium: Medium, thing: dict[str, object], *, spp: int) -> None:
        renderer = Renderer(sensor, medium, scene_of(thing, plate(60.0, side=150.0, x=40.0)))
        renderer.laser_frame(sensor_at(x=0.5), spp=spp).irradiance()
        renderer.irradiance("lamp", sensor_at(x=0.5), spp=spp)

    frames(altered(thesis, SMALL), clear(0.3, 0.5), sphere(), spp=4)
    assert new_kernels()[1] >= 4
    frames(altered(thesis, OTHER), clear(0.5, 0.2), sphere() | {"diameter_mm": 38.1}, spp=7)
    launched, new = new_kernels()
    assert launched >= 10
    assert new == 0
    # Without an effect, other kernels are compiled: the count detects it.
    frames(altered(thesis, SMALL), clear(0.3), sphere(), spp=4)
    assert new_kernels()[1] > 0


def test_another_texture_and_translucency_compile_nothing(thesis, new_kernels):
    def frames(changes: dict[str, object], *, seed: int) -> None:
        grown = sphere() | {"finish": "fouled-steel"} | changes
        pipe = plate(60.0, side=150.0, x=40.0) | {"reflectance": 0.6, "finish": "pvc-pipe"}
        renderer = Renderer(altered(thesis, SMALL), clear(0.3), scene_of(grown, pipe), seed=seed)
        renderer.laser_frame(sensor_at(x=0.5), spp=4).irradiance()

    frames({}, seed=1)
    assert new_kernels()[1] >= 4
    frames({"mottle": 0.1, "mottle_mm": (3.0, 1.0, 0.3), "patch_share": 0.1, "reflectance": 0.3}, seed=2)
    launched, new = new_kernels()
    assert launched >= 5
    assert new == 0


@pytest.mark.slow
def test_scenes_of_a_data_set_share_their_kernels(thesis, new_kernels):
    table = load_description("stripe-clean").model_dump() | {"sensor": altered(thesis, SMALL), "spp": 4}
    described = DataSetDescription.model_validate(table)

    def scene(number: int) -> None:
        drawn = draw_scene(described, number)
        studio = SensorSimulator(drawn.as_built, drawn.scene, drawn.options, probe="middle")
        for index, shot in enumerate(drawn.scene.motion.shots()):
            make_labels(studio, shot, studio.expose(shot, index), described.labels)

    scene(0)
    assert new_kernels()[1] >= 4
    for number in (1, 2):
        scene(number)
    launched, new = new_kernels()
    assert launched > 50
    assert new == 0
