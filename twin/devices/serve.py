"""Serves a scene as hardware: a Grbl controller on a pseudo terminal and a GigE Vision camera, joined by the bench."""

import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import count

import numpy as np

from twin.devices.bench import Bench, FrameRates, Track, parse_fault
from twin.devices.gige_camera import GigeCamera
from twin.devices.grbl_controller import GrblController
from twin.options import CPU, Options, Variant, use_variant
from twin.recording.recording import AnyScene, AnySensor, choose_scene, choose_sensors
from twin.scene.description import altered
from uwlts.model.errors import DescriptionError

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

    def wait_for_end(self) -> None:
        """Return at Ctrl-C, or when the process is asked to terminate; raise what kept the camera from making a frame.

        A shell makes programs in its background ignore Ctrl-C; a service must not.
        """
        ended = threading.Event()
        before = {number: signal.signal(number, lambda *_: ended.set()) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            while not ended.wait(_WATCH_S):
                if self.camera.failure is not None:
                    raise self.camera.failure
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


@contextmanager
def serve(
    scene: AnyScene,
    *,
    sensor: AnySensor = "thesis",
    as_built: AnySensor | None = None,
    placement: str | None = None,
    medium: str | None = None,
    water: float | str | None = None,
    spp: int = 16,
    seed: int = 0,
    without: Sequence[str] = (),
    ideal: bool = False,
    stage_start: float | None = None,
    lamp: bool | None = None,
    speed_up: float = 1.0,
    fault: Sequence[str] = (),
    variant: Variant = CPU,
    report: Callable[[str], None] = lambda line: None,
) -> Iterator[ServedTwin]:
    """Serve a scene as hardware: a GigE Vision camera and a Grbl controller with stage and laser.

    A frame shows what the camera sees where the stage stands, with the laser as it is. Camera and controller can be
    reached from this machine only.

    Parameters
    ----------
    sensor
        Name or path of the sensor description that the sensor's software will be given.
    placement
        Named place of the objects, such as near, standoff or far.
    without
        Effects to leave out, as for `simulate`; a moving stage does not blur the image in any case.
    ideal
        Leave out all effects: a pinhole's sharp image without noise.
    stage_start
        Stage position in mm at which the scene's motion starts; the middle of the travel is used unless given. There
        the stage stands at first.
    lamp
        Whether the lamp is on while the laser is off; if the scene's motion has lamp images unless given.
    speed_up
        How much faster than real the stage moves.
    fault
        Faults as NAME[:ARGUMENT][@FRAME], each with the frame of that number, else with the first: drop, repeat or cut
        (so many frames), delay (s), camera-disconnect, stage-disconnect, mute, stall, stop-short or lose-steps (steps),
        alarm (number), hold, restart, garbage, break-laser.
    report
        Called with a line of text for every fault, by the camera's thread.
    scene, as_built, medium, water, spp, seed, variant
        As for `simulate`.

    Returns
    -------
    context manager of ServedTwin
        Its addresses and exposures; the scene is served within the ``with``.

    Raises
    ------
    DescriptionError, DesignError
        A description, name or option is wrong, the sensor cannot work, or the motion does not fit the stage.
    HardwareError
        Another camera is served on this machine.
    SetupError
        Aravis is not installed, or Mitsuba cannot use the variant.
    """
    described = choose_scene(scene, placement=placement, medium=medium, water=water)
    options = Options.chosen(spp=spp, seed=seed, without=without, ideal=ideal)
    if not speed_up > 0:
        raise DescriptionError(f"speed_up is {speed_up:g}; it must be positive")
    _, built = choose_sensors(sensor, as_built)
    faults = [parse_fault(text) for text in fault]
    use_variant(variant)
    from twin.recording.studio import Studio

    track = Track.on(built.stage, described.motion, start_mm=stage_start)
    lamp = "lamp" in described.motion.lights if lamp is None else lamp
    # The controller moves the stage, and a frame may ask for any light.
    at_rest = {"lights": ("lamp", "laser") if lamp else ("laser",), "speed_mm_per_s": 0.0}
    studio = Studio(built, altered(described, motion=at_rest), options)
    settings = {_STEPS_PER_MM: 1 / built.stage.resolution_mm, _TRAVEL: built.stage.travel_mm}
    controller = GrblController(settings=settings, position_mm=track.start_mm, speed_up=speed_up)
    bench = Bench(studio, state=controller.state, track=track, lamp=lamp)
    numbers = count(1)

    def inject(number: int, *, ahead: bool) -> None:
        for each in faults:
            if (each.frame, each.ahead) == (number, ahead):
                each.inject(controller, camera)
                report(f"fault: {each}")

    def frame(exposure_ms: float) -> np.ndarray:
        number = next(numbers)
        inject(number, ahead=False)
        image = bench.frame(exposure_ms)
        inject(number + 1, ahead=True)
        return image

    camera = GigeCamera(frame, width_px=built.camera.width_px, height_px=built.camera.height_px)
    inject(1, ahead=True)
    with controller, camera:
        yield ServedTwin(controller, camera, track, studio.exposure_ms, lambda: bench.rates)
