"""Frames after the first reuse its kernels, wherever the sensor stands and however many pixels are lit."""

import drjit as dr
import numpy as np
import pytest

from tests.virtual_sensors import altered, clear, plate, scene_of, sensor_at
from twin.light.pose import SensorPose
from twin.light.renderer import Renderer
from twin.recording.studio import true_stripe
from twin.scene.description import load_scene


@pytest.fixture
def new_kernels():
    """Counts kernels launched since the last call that were compiled or read from disk, not found in memory."""
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
    # A focal length of its own makes sure that no other test has left these kernels in memory.
    sensor = altered(
        thesis, {"camera": {"width_px": 320, "height_px": 256, "pixel_size_um": 21.2, "focal_length_mm": 12.61}}
    )
    renderer = Renderer(sensor, clear(0.3, 0.5), scene_of(sphere(), plate(60.0, side=150.0, x=40.0)))
    new_kernels()

    def frame(index: int, pose: np.ndarray) -> int:
        image = renderer.irradiance("laser", pose, spp=4 + index % 2)
        true_stripe(renderer, pose)
        return len(renderer.lit_pixels(SensorPose(pose))[0]) + 0 * len(image)

    for index in range(2):
        frame(index, sensor_at(x=0.5))
    assert new_kernels()[1] >= 4, "the first frames must compile something, or nothing is tested"
    lit = {frame(index, sensor_at(3.0 * index, x=2.7 * index - 40.0)) for index in range(2, 30)}
    assert len(lit) > 10, "the number of lit pixels changes"
    launched, new = new_kernels()
    assert launched > 100
    assert new == 0
    assert renderer.irradiance("laser", sensor_at(x=500.0), spp=4).max() >= 0, "a frame with nothing in view"
    assert new_kernels()[1] == 0


def test_lamp_images_compile_nothing_after_the_first(thesis, new_kernels):
    sensor = altered(
        thesis, {"camera": {"width_px": 320, "height_px": 256, "pixel_size_um": 21.2, "focal_length_mm": 12.62}}
    )
    renderer = Renderer(sensor, clear(), load_scene("target"))
    new_kernels()
    renderer.irradiance("lamp", sensor_at(), spp=4)
    assert new_kernels()[1] >= 2
    for index in range(8):
        renderer.irradiance("lamp", sensor_at(-15.0 * index, x=index), spp=4)
    launched, new = new_kernels()
    assert launched >= 16
    assert new == 0
    # A number that is compiled in, such as the absorption, does compile anew: the count can tell.
    Renderer(sensor, clear(0.4), load_scene("target")).irradiance("lamp", sensor_at(), spp=4)
    assert new_kernels()[1] > 0
