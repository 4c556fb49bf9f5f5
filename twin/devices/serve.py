"""Serves a scene as hardware: a Grbl controller on a pseudo terminal and a GigE Vision camera, joined by the bench."""

import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from twin.devices.bench import Bench, Fault, FrameRates, Track
from twin.devices.gige_camera import GigeCamera
from twin.devices.grbl_controller import GrblController
from twin.options import Options
from twin.recording.studio import Studio
from twin.scene.description import Scene
from uwlts.model.sensor import Sensor

_STEPS_PER_MM, _TRAVEL = 100, 130
_WATCH_S = 0.2


@dataclass(frozen=True)
class ServedTwin:
    """A served stage and camera, the place of the scene, and exposures in ms that suit it."""

    controller: GrblController
    camera: GigeCamera
    track: Track
    exposure_ms: dict[str, float]
    rates: Callable[[], FrameRates]

    def lines(self) -> list[str]:
        """Ports, motion and exposures, as lines for the operator."""
        motion, start_mm = self.track.motion, self.track.start_mm
        end_mm = start_mm + (motion.count - 1) * motion.step_mm
        suited = ", ".join(f"{light} {exposure:.3f} ms" for light, exposure in self.exposure_ms.items())
        return [
            f"stage:    {self.controller.port}",
            f"camera:   {self.camera.address}",
            f"motion:   {motion.count} positions, {start_mm:g} to {end_mm:g} mm of the stage in steps of "
            f"{motion.step_mm:g} mm",
            f"offset:   the scene's position is the stage's less {self.track.offset_mm:g} mm",
            f"exposure: {suited}",
        ]


@contextmanager
def serve(
    scene: Scene,
    sensor: Sensor,
    *,
    options: Options = Options(),
    stage_start_mm: float | None = None,
    lamp: bool | None = None,
    faults: Iterable[Fault] = (),
    speed_up: float = 1.0,
    report: Callable[[str], None] = lambda line: None,
) -> Iterator[ServedTwin]:
    """Serve a sensor before a scene within a ``with``; everything listens on this machine alone.

    Parameters
    ----------
    stage_start_mm
        Stage position at which the scene's motion starts; such that it lies in the middle of the travel unless given.
        There the stage stands at first.
    lamp
        Whether the lamp is on while the laser is off; if the scene's motion has lamp images unless given.
    speed_up
        How much faster than real the stage moves.
    report
        Called with a line of text for every fault, by the camera's thread.

    Raises
    ------
    DescriptionError, DesignError
        The sensor or the scene cannot work, or the motion does not fit the stage.
    HardwareError
        Another camera is served on this machine.
    SetupError
        Aravis is not installed.
    """
    track = Track.on(sensor.stage, scene.motion, start_mm=stage_start_mm)
    lamp = "lamp" in scene.motion.lights if lamp is None else lamp
    studio = Studio(sensor, _at_rest(scene, lamp=lamp), options)
    settings = {_STEPS_PER_MM: 1 / sensor.stage.resolution_mm, _TRAVEL: sensor.stage.travel_mm}
    controller = GrblController(settings=settings, position_mm=track.start_mm, speed_up=speed_up)
    bench = Bench(studio, state=controller.state, track=track, lamp=lamp)
    frames = _FaultyFrames(bench, tuple(faults), report)
    built = sensor.camera
    camera = GigeCamera(frames, width_px=built.width_px, height_px=built.height_px)
    frames.join(controller, camera)
    with controller, camera:
        yield ServedTwin(controller, camera, track, studio.exposure_ms, lambda: bench.rates)


def wait_for_end(served: ServedTwin) -> None:
    """Return at Ctrl-C, or when the process is asked to terminate; raise what kept the camera from making a frame.

    A shell makes programs in its background ignore Ctrl-C; a service must not.
    """
    ended = threading.Event()
    before = {number: signal.signal(number, lambda *_: ended.set()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        while not ended.wait(_WATCH_S):
            if served.camera.failure is not None:
                raise served.camera.failure
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _at_rest(scene: Scene, *, lamp: bool) -> Scene:
    """The scene with all its lights at a stage that the controller moves."""
    lights = ("lamp", "laser") if lamp else ("laser",)
    return scene.model_copy(
        update={"motion": scene.motion.model_copy(update={"lights": lights, "speed_mm_per_s": 0.0})}
    )


class _FaultyFrames:
    """The bench's frames, each with the faults that come with it."""

    def __init__(self, bench: Bench, faults: tuple[Fault, ...], report: Callable[[str], None]):
        self._bench, self._faults, self._report = bench, faults, report
        self._begun = 0

    def join(self, controller: GrblController, camera: GigeCamera) -> None:
        """Give the devices that faults are injected into."""
        self._devices = controller, camera
        self._inject(1, ahead=True)

    def __call__(self, exposure_ms: float) -> np.ndarray:
        self._begun += 1
        self._inject(self._begun, ahead=False)
        image = self._bench.frame(exposure_ms)
        self._inject(self._begun + 1, ahead=True)
        return image

    def _inject(self, frame: int, *, ahead: bool) -> None:
        for fault in self._faults:
            if (fault.frame, fault.ahead) == (frame, ahead):
                fault.inject(*self._devices)
                self._report(f"fault: {fault}")
