"""Rate of frames rendered while a stage moves, as by a served twin."""

import math

from tests.bench.rows import median_seconds
from twin.devices.grbl_controller import StageState
from twin.devices.serve import Bench, Track
from twin.recording.sensor_simulator import SensorSimulator
from twin.rendering_options import Options
from twin.scene.description import load_scene
from uwlts.model.library import load_sensor

LESS_LIGHT = ("multiple-scattering", "secondary-light")
"""Effects of weak light, which take half of the time of a frame."""
_EXPOSURE_MS, _RATE_HZ, _SPEED_MM_PER_S = 1.0, 30.0, 10.0


def frame_rate(*without: str) -> float:
    """Return rendered frames per second of 640 x 512 pixels of a stage in motion, with the detector, to memory."""
    scene, sensor = load_scene("spheres"), load_sensor("thesis-small")
    options = Options.from_names(spp=Options().spp, seed=0, effects=(), without=without, ideal=False)
    track = Track.place(sensor.stage, scene.motion)

    def state(k: int) -> StageState:
        position_mm = track.start_mm + (math.fmod(k, 60) + 20) * _SPEED_MM_PER_S / _RATE_HZ
        return StageState(k / _RATE_HZ, position_mm, _SPEED_MM_PER_S, True, 1.0, True)

    bench = Bench(SensorSimulator(sensor, scene, options), state=lambda: state(0), track=track, lamp=False)
    return 1.0 / median_seconds(lambda k: bench.frame(_EXPOSURE_MS, state(k)), warm_up=5, runs=40)
