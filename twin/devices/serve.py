"""Service of a scene as hardware: a Grbl controller on a pseudo terminal and a GigE Vision camera.

The bench renders the camera's images for the state of stage and laser. Faults NAME[:ARGUMENT][@FRAME] can be injected.
"""

import math
import re
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import count
from typing import TYPE_CHECKING

import numpy as np

from twin.devices.gige_camera import ExposedFrame, GigeCamera
from twin.devices.grbl_controller import GrblController, StageState
from twin.recording.render import AnyScene, choose_scene
from twin.rendering_options import CPU, Options, Variant, use_variant
from twin.scene.campaign import AnySensor, choose_sensors
from twin.scene.description import AnyMotion, replace_values
from twin.scene.platforms import Light, Motion, Shot
from uwlts.errors import DescriptionError, DesignError
from uwlts.model.sensor import Stage

if TYPE_CHECKING:  # it needs Mitsuba
    from twin.light.pose import Travel
    from twin.recording.sensor_simulator import SensorSimulator

# Numbers of Grbl's settings of the X axis.
_STEPS_PER_MM = 100
_SPEED = 110
_ACCELERATION = 120
_TRAVEL = 130
_WATCH_S = 0.2
_FORM = re.compile(r"(?P<name>[a-z-]+)(:(?P<argument>[^@]+))?(@(?P<frame>[1-9]\d*))?")


_ARGUMENTS: dict[str, float | None] = {
    **dict.fromkeys(("drop", "repeat", "cut"), 1),
    "delay": 1.0,
    **dict.fromkeys(("camera-disconnect", "stage-disconnect", "mute", "cut-line", "stall")),
    **dict.fromkeys(("stop-short", "lose-steps"), 40),
    "alarm": 1,
    **dict.fromkeys(("hold", "restart", "garbage", "break-laser")),
}
"""Default argument of each fault, of the type that it takes; None if it takes no argument."""
NAMES = tuple(_ARGUMENTS)


@dataclass(frozen=True)
class Fault:
    """Fault at a frame; frames are numbered from 1 in the order of requests to the camera."""

    name: str
    argument: float | None
    frame: int

    @property
    def ahead(self) -> bool:
        """True if it must be injected before its frame starts, after the previous frame."""
        return self.name == "delay"

    def inject(self, stage: GrblController, camera: GigeCamera) -> None:
        """Inject the fault."""
        value = 1 if self.argument is None else self.argument
        match self.name:
            case "drop" | "repeat" | "cut":
                camera.inject(self.name, int(value))
            case "delay":
                camera.inject("delay", delay_s=value)
            case "camera-disconnect":
                camera.disconnect()
            case _:
                stage.inject(self.name, value)

    def __str__(self) -> str:
        return f"{self.name}{'' if self.argument is None else f':{self.argument:g}'} at frame {self.frame}"


def parse_fault(text: str) -> Fault:
    """Parse a fault NAME[:ARGUMENT][@FRAME]; defaults are those of `_ARGUMENTS`, and the first frame.

    Raises DescriptionError if the fault is unknown, or the argument is not valid.
    """
    found = _FORM.fullmatch(text)
    if not found or found["name"] not in _ARGUMENTS:
        raise DescriptionError(f"'{text}' is not a fault: write NAME[:ARGUMENT][@FRAME] with one of {', '.join(NAMES)}")
    name, argument = found["name"], found["argument"]
    value = _ARGUMENTS[name]
    if argument is not None:
        if value is None:
            raise DescriptionError(f"the fault {name} takes no argument; found '{argument}'")
        kind = type(value)
        try:
            value = kind(argument)
        except ValueError as error:
            wanted = "a whole number" if kind is int else "a number of seconds"
            raise DescriptionError(f"the argument of {name} is '{argument}', not {wanted}") from error
        # Steps can be lost in both directions.
        if not math.isfinite(value) or (value <= 0 and name != "lose-steps"):
            raise DescriptionError(f"the argument of {name} is '{argument}'; it must be positive")
    return Fault(name, value, int(found["frame"] or 1))


# Streams of random numbers: walks depend on the position, noise on the frame.
_WALKS = 0
_NOISE = 1


@dataclass(frozen=True)
class Track:
    """Position of the scene's motion on the stage: it starts at the stage position ``start_mm``."""

    motion: Motion
    start_mm: float

    @classmethod
    def place(cls, stage: Stage, motion: AnyMotion, *, start_mm: float | None = None) -> "Track":
        """Place a motion at ``start_mm``, by default in the middle of the travel, rounded to a step.

        Raises DescriptionError if the motion is not one of the stage, or not within the travel.
        """
        if not isinstance(motion, Motion):
            raise DescriptionError(f"the scene moves on a {motion.kind}; expected one with a motion of the stage")
        way_mm = (motion.count - 1) * motion.step_mm
        if start_mm is None:
            start_mm = round((stage.travel_mm - way_mm) / 2 / stage.resolution_mm) * stage.resolution_mm
        low, high = sorted((start_mm, start_mm + way_mm))
        # Rounding to a step can move a motion as long as the travel beyond its end by half a step.
        if not -stage.resolution_mm <= low <= high <= stage.travel_mm + stage.resolution_mm:
            raise DescriptionError(
                f"the scene's motion would run from {low:g} to {high:g} mm of the stage, whose travel is 0 to "
                f"{stage.travel_mm:g} mm: change `stage_start`, or shorten the motion"
            )
        return cls(motion, start_mm)

    @property
    def offset_mm(self) -> float:
        """Stage position of the scene's position 0."""
        return self.start_mm - self.motion.start_mm

    def shot(self, position_mm: float, light: Light) -> Shot:
        """Return the shot at a stage position; the stage's errors are interpolated between the motion's positions."""
        scene_mm, motion = position_mm - self.offset_mm, self.motion
        error_mm = 0.0
        if motion.position_errors_mm:
            places = motion.start_mm + motion.step_mm * np.arange(motion.count)
            order = np.argsort(places)
            error_mm = float(np.interp(scene_mm, places[order], np.array(motion.position_errors_mm)[order]))
        return Shot(stage_mm=scene_mm, travelled_mm=scene_mm + error_mm, light=light)


class Bench:
    """Renderer of frames for a stage; used by one thread.

    ``state()`` returns the present true state of the stage, and ``track`` is the position of the scene's motion on it.
    With ``lamp``, the lamp is on while the laser is off. ``frames`` are counted, and ``renderings`` of their light; at
    rest it is kept. Raises DesignError if the detector does not have 8 bits.
    """

    def __init__(self, simulator: "SensorSimulator", *, state: Callable[[], StageState], track: Track, lamp: bool):
        bits = simulator.sensor.detector.bits
        if bits != 8:
            raise DesignError(f"the served camera has 8 bits, the sensor's detector {bits}: set bits = 8")
        self.frames = self.renderings = 0
        self._simulator, self._state, self._track, self._lamp = simulator, state, track, lamp
        self._travelled_mm = math.nan
        self._seen: dict[str, np.ndarray] = {}

    def prepare(self, exposure_ms: float) -> None:
        """Compile the kernels for laser images with a trial image, because the compilation exceeds an exposure."""
        state = replace(self._state(), laser_on=True, power=1.0)
        light, noise_seed = self._render_electrons_per_ms(state, None), [self._simulator.options.seed]
        self._simulator.formation.detect(exposure_ms * light, exposure_ms=exposure_ms, noise_seed=noise_seed)
        self._travelled_mm, self.renderings = math.nan, 0

    def frame(self, exposure_ms: float, state: StageState | None = None) -> np.ndarray:
        """Render the image (height_px, width_px), uint8, of a state, by default the present one.

        A given state includes motion blur. The noise is different in each call.
        """
        travel = None
        if state is not None and state.moving and self._simulator.options.effects.motion:
            velocity = state.speed_mm_per_s * self._track.motion.unit_direction()
            travel = self._simulator.travel_at(velocity, np.zeros(3), exposure_ms=exposure_ms)
            self._seen.clear()
        light = exposure_ms * self._render_electrons_per_ms(state or self._state(), travel)
        if travel is not None:
            self._seen.clear()
        noise_seed = [self._simulator.options.seed, _NOISE, self.frames]
        self.frames += 1
        return self._simulator.formation.detect(light, exposure_ms=exposure_ms, noise_seed=noise_seed)

    def _render_electrons_per_ms(self, state: StageState, travel: "Travel | None") -> np.ndarray:
        """Return mean photo-electrons per ms (H, W), without noise; those of the latest position are kept."""
        travelled_mm = self._track.shot(state.position_mm, "laser").travelled_mm
        if travelled_mm != self._travelled_mm:
            self._travelled_mm, self._seen = travelled_mm, {}
        if state.power == 0:
            return self._look_up_light("lamp" if self._lamp else "day", state, travel)
        laser = self._look_up_light("laser", state, travel)
        if state.power >= 1:
            return laser
        # A laser frame includes the daylight, which does not depend on the laser's power.
        day = self._look_up_light("day", state, travel)
        return day + np.float32(state.power) * np.maximum(laser - day, 0)

    def _look_up_light(self, light: Light, state: StageState, travel: "Travel | None") -> np.ndarray:
        if light not in self._seen:
            shot, options = self._track.shot(state.position_mm, light), self._simulator.options
            # Position in whole um as a non-negative seed.
            place = round(1e3 * shot.travelled_mm) % 2**32
            seed = int(np.random.SeedSequence([options.seed, _WALKS, place]).generate_state(1)[0])
            self.renderings += 1
            self._seen[light] = self._simulator.electrons_per_ms(shot, spp=options.spp, seed=seed, travel=travel)
        return self._seen[light]


@dataclass(frozen=True)
class ServedTwin:
    """Served stage and camera, position of the scene on the stage, suitable exposures in ms, and the bench."""

    controller: GrblController
    camera: GigeCamera
    track: Track
    exposure_ms: dict[str, float]
    bench: Bench

    def lines(self) -> list[str]:
        """Return ports, motion and exposures as lines of text."""
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
        """Wait for Ctrl-C or a termination signal; raise an exception that occurred while making a frame.

        Handlers are installed explicitly, because shells make background programs ignore Ctrl-C.
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
    effects: Sequence[str] = (),
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

    A frame shows the scene at the stage's present position, with the laser on or off. A free-running camera exposes at
    its frame rate, independent of the rendering time; its frames arrive later, with true time stamps. Camera and
    controller can only be reached from this machine.

    Parameters
    ----------
    sensor
        Name or path of the sensor description for the sensor software.
    placement
        Named position of the objects, such as near, standoff or far.
    effects
        Effects of real images to add, as for `simulate`, except lamp-and-laser, because the controller switches the
        laser.
    without
        Effects to omit, as for `simulate`. Motion blur affects a free-running camera, not a triggered one. Without
        multiple-scattering and secondary-light, a frame takes half of the time, but its light is less accurate: no halo
        of scattered light, and no light between surfaces.
    ideal
        Omit all effects: a pinhole's sharp image without noise.
    stage_start
        Stage position in mm at the start of the scene's motion, and initial position of the stage; default: the motion
        is in the middle of the travel.
    lamp
        Switch the lamp on while the laser is off; default: if the scene's motion has lamp images.
    speed_up
        Factor of the stage's speed.
    fault
        Faults as NAME[:ARGUMENT][@FRAME], by default at the first frame: drop, repeat or cut (number of frames), delay
        (s), camera-disconnect, stage-disconnect, mute, cut-line, stall, stop-short or lose-steps (steps), alarm
        (number), hold, restart, garbage, break-laser.
    report
        Called with a line of text for each fault, in the camera's thread.
    scene, as_built, medium, water, spp, seed, variant
        As for `simulate`.

    Returns
    -------
    context manager of ServedTwin
        Addresses and exposures; the scene is served within the ``with`` block.

    Raises
    ------
    DescriptionError, DesignError
        A description, name or option is invalid, the sensor cannot work, or the motion does not fit the stage.
    HardwareError
        Another camera is served on this machine.
    SetupError
        Aravis is not installed, or Mitsuba cannot use the variant.
    """
    described = choose_scene(scene, placement=placement, medium=medium, water=water)
    options = Options.from_names(spp=spp, seed=seed, effects=effects, without=without, ideal=ideal)
    if options.flaws.lamp_and_laser:
        raise DescriptionError("lamp-and-laser cannot be served, because the controller switches the laser: remove it")
    if not speed_up > 0:
        raise DescriptionError(f"speed_up is {speed_up:g}; it must be positive")
    _, built = choose_sensors(sensor, as_built)
    faults = [parse_fault(text) for text in fault]
    track = Track.place(built.stage, described.motion, start_mm=stage_start)
    use_variant(variant)
    from twin.recording.sensor_simulator import SensorSimulator

    lamp = "lamp" in track.motion.lights if lamp is None else lamp
    # The controller moves the stage, and a frame can need any light.
    at_rest = {"lights": ("lamp", "laser") if lamp else ("laser",), "speed_mm_per_s": 0.0}
    simulator = SensorSimulator(built, replace_values(described, motion=at_rest), options)
    settings = {_STEPS_PER_MM: 1 / built.stage.resolution_mm, _SPEED: 60 * built.stage.speed_mm_per_s}
    settings |= {_ACCELERATION: built.stage.acceleration_mm_per_s2, _TRAVEL: built.stage.travel_mm}
    controller = GrblController(settings=settings, position_mm=track.start_mm, speed_up=speed_up)
    bench = Bench(simulator, state=controller.state, track=track, lamp=lamp)
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

    def expose() -> ExposedFrame:
        state = controller.state()

        def image(exposure_ms: float) -> np.ndarray:
            number = next(numbers)
            inject(number, ahead=False)
            return bench.frame(exposure_ms, state)

        return ExposedFrame(state.time_s, controller.steps(state), image)

    camera = GigeCamera(
        frame, width_px=built.camera.width_px, height_px=built.camera.height_px, encoder=controller.steps, expose=expose
    )
    inject(1, ahead=True)
    bench.prepare(simulator.exposure_ms["laser"])
    with controller, camera:
        yield ServedTwin(controller, camera, track, simulator.exposure_ms, bench)
