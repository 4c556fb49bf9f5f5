"""Serves a scene as hardware: a Grbl controller on a pseudo terminal and a GigE Vision camera, joined by a bench.

The bench renders what the camera sees of scene, stage and laser; faults NAME[:ARGUMENT][@FRAME] disturb it.
"""

import math
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import count
from typing import TYPE_CHECKING

import numpy as np

from twin.devices.gige_camera import ExposedFrame, GigeCamera
from twin.devices.grbl_controller import GrblController, StageState
from twin.options import CPU, Options, Variant, use_variant
from twin.recording.render import AnyScene, AnySensor, choose_scene, choose_sensors
from twin.scene.description import altered
from twin.scene.motion import Light, Motion, Shot
from uwlts.errors import DescriptionError, DesignError
from uwlts.model.sensor import Stage

if TYPE_CHECKING:  # it needs Mitsuba
    from twin.light.pose import Travel
    from twin.recording.studio import Studio

# Numbers of Grbl's settings of the X axis.
_STEPS_PER_MM = 100
_SPEED = 110
_ACCELERATION = 120
_TRAVEL = 130
_WATCH_S = 0.2
_FORM = re.compile(r"(?P<name>[a-z-]+)(:(?P<argument>[^@]+))?(@(?P<frame>[1-9]\d*))?")


@dataclass(frozen=True)
class _Kind:
    """A fault's argument unless given, None where it takes none, and which arguments it takes."""

    argument: float | None = None
    whole: bool = True
    signed: bool = False


_KINDS = {
    **dict.fromkeys(("drop", "repeat", "cut"), _Kind(1)),
    "delay": _Kind(1.0, whole=False),
    **dict.fromkeys(("camera-disconnect", "stage-disconnect", "mute", "cut-line", "stall"), _Kind()),
    "stop-short": _Kind(40),
    "lose-steps": _Kind(40, signed=True),
    "alarm": _Kind(1),
    **dict.fromkeys(("hold", "restart", "garbage", "break-laser"), _Kind()),
}
NAMES = tuple(_KINDS)


@dataclass(frozen=True)
class Fault:
    """A fault that comes with a frame, counted from 1 as the camera is asked for them."""

    name: str
    argument: float | None
    frame: int

    @property
    def ahead(self) -> bool:
        """Whether it has to be injected before its frame is begun, which is when the one before is done."""
        return self.name == "delay"

    def inject(self, stage: GrblController, camera: GigeCamera) -> None:
        """Let it happen."""
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
    """A fault from NAME[:ARGUMENT][@FRAME], by default of the kind's own argument with the first frame.

    DescriptionError where there is no such fault, or its argument is none.
    """
    found = _FORM.fullmatch(text)
    if not found or found["name"] not in _KINDS:
        raise DescriptionError(f"'{text}' is no fault: write NAME[:ARGUMENT][@FRAME] with one of {', '.join(NAMES)}")
    kind, argument = _KINDS[found["name"]], found["argument"]
    if argument is not None and kind.argument is None:
        raise DescriptionError(f"the fault {found['name']} takes no argument, '{argument}' was given")
    value = kind.argument
    if argument is not None:
        try:
            value = int(argument) if kind.whole else float(argument)
        except ValueError as error:
            wanted = "a whole number" if kind.whole else "a number of seconds"
            raise DescriptionError(f"the argument of {found['name']} is '{argument}', not {wanted}") from error
        if not math.isfinite(value) or (value <= 0 and not kind.signed):
            raise DescriptionError(f"the argument of {found['name']} is '{argument}'; it must be positive")
    return Fault(found["name"], value, int(found["frame"] or 1))


# Keeps the random numbers of the walks, which follow the place, apart from those of the noise, which follow the frame.
_WALKS = 0
_NOISE = 1


@dataclass(frozen=True)
class Track:
    """Place of the scene's motion on the stage: it starts at ``start_mm`` of the stage's own positions."""

    motion: Motion
    start_mm: float

    @classmethod
    def on(cls, stage: Stage, motion: Motion, *, start_mm: float | None = None) -> "Track":
        """The motion in the middle of the travel, on a whole step, unless ``start_mm`` says where it starts.

        DescriptionError where the motion does not lie within the travel.
        """
        way_mm = (motion.count - 1) * motion.step_mm
        if start_mm is None:
            start_mm = round((stage.travel_mm - way_mm) / 2 / stage.resolution_mm) * stage.resolution_mm
        low, high = sorted((start_mm, start_mm + way_mm))
        # A motion as long as the travel may lie beyond its end by half the step to which its start was rounded.
        if not -stage.resolution_mm <= low <= high <= stage.travel_mm + stage.resolution_mm:
            raise DescriptionError(
                f"the scene's motion would run from {low:g} to {high:g} mm of the stage, whose travel is 0 to "
                f"{stage.travel_mm:g} mm: start it elsewhere, or shorten it"
            )
        return cls(motion, start_mm)

    @property
    def offset_mm(self) -> float:
        """Stage position of the scene's position 0."""
        return self.start_mm - self.motion.start_mm

    def shot(self, position_mm: float, light: Light) -> Shot:
        """The shot at a position of the stage; errors of the stage between the scan's positions are interpolated."""
        scene_mm, motion = position_mm - self.offset_mm, self.motion
        error_mm = 0.0
        if motion.position_errors_mm:
            places = motion.start_mm + motion.step_mm * np.arange(motion.count)
            order = np.argsort(places)
            error_mm = float(np.interp(scene_mm, places[order], np.array(motion.position_errors_mm)[order]))
        return Shot(stage_mm=scene_mm, travelled_mm=scene_mm + error_mm, light=light)


@dataclass(frozen=True)
class FrameRates:
    """Numbers of frames made and rendered, and the times in s that rendered and repeated ones took."""

    frames: int = 0
    rendered: int = 0
    rendering_s: float = 0.0
    repeating_s: float = 0.0

    def __str__(self) -> str:
        repeated = self.frames - self.rendered
        parts = [f"{self.frames} frames"]
        if self.rendered:
            parts.append(f"{self.rendered} rendered at {self.rendered / self.rendering_s:.1f} frames/s")
        if repeated:
            parts.append(f"{repeated} of the same place at {repeated / self.repeating_s:.1f} frames/s")
        return ", ".join(parts)


class Bench:
    """Frames of a studio for a stage whose ``state()`` is true at the moment of the call; used by one thread.

    ``track`` is where the scene lies on the stage; the lamp is on while the laser is off if ``lamp``. DesignError where
    the detector does not have 8 bit.
    """

    def __init__(self, studio: "Studio", *, state: Callable[[], StageState], track: Track, lamp: bool):
        bits = studio.sensor.detector.bits
        if bits != 8:
            raise DesignError(f"the served camera gives 8 bit, the sensor's detector {bits}: set bits = 8")
        self.rates = FrameRates()
        self._studio, self._state, self._track, self._lamp = studio, state, track, lamp
        self._travelled_mm = math.nan
        self._seen: dict[str, np.ndarray] = {}

    def prepare(self, exposure_ms: float) -> None:
        """Compile what renders a laser image, which takes longer than a laser is lit for one, and forget the image."""
        state = replace(self._state(), laser_on=True, power=1.0)
        light = self._electrons_per_ms(state, None)
        self._studio.detected(exposure_ms * light, exposure_ms=exposure_ms, noise_seed=[self._studio.options.seed])
        self._travelled_mm = math.nan

    def frame(self, exposure_ms: float, state: StageState | None = None) -> np.ndarray:
        """Image (height_px, width_px) of uint8 of a moment, now unless given; noise differs from call to call.

        The stage's movement shows in the image if the moment is given.
        """
        began, known = time.perf_counter(), len(self._seen)
        travel = None if state is None else self._studio.travel_at(state.speed_mm_per_s, exposure_ms=exposure_ms)
        state = state or self._state()
        if travel is not None:
            self._seen.clear()
        at_rest = self._track.shot(state.position_mm, "laser").travelled_mm == self._travelled_mm
        light = exposure_ms * self._electrons_per_ms(state, travel)
        if travel is not None:
            self._seen.clear()
        noise_seed = [self._studio.options.seed, _NOISE, self.rates.frames]
        image = self._studio.detected(light, exposure_ms=exposure_ms, noise_seed=noise_seed)
        seconds, rates = time.perf_counter() - began, replace(self.rates, frames=self.rates.frames + 1)
        if at_rest and len(self._seen) == known:
            self.rates = replace(rates, repeating_s=rates.repeating_s + seconds)
        else:
            self.rates = replace(rates, rendered=rates.rendered + 1, rendering_s=rates.rendering_s + seconds)
        return image

    def _electrons_per_ms(self, state: StageState, travel: "Travel | None") -> np.ndarray:
        """Mean photo-electrons per ms (H, W), without noise; the latest place's are kept."""
        travelled_mm = self._track.shot(state.position_mm, "laser").travelled_mm
        if travelled_mm != self._travelled_mm:
            self._travelled_mm, self._seen = travelled_mm, {}
        if state.power == 0:
            return self._light("lamp" if self._lamp else "day", state, travel)
        laser = self._light("laser", state, travel)
        if state.power >= 1:
            return laser
        # A laser frame holds the daylight, which a weaker laser leaves as it is.
        day = self._light("day", state, travel)
        return day + np.float32(state.power) * np.maximum(laser - day, 0)

    def _light(self, light: Light, state: StageState, travel: "Travel | None") -> np.ndarray:
        if light not in self._seen:
            shot, options = self._track.shot(state.position_mm, light), self._studio.options
            # Whole um, which are all different places; seeds must not be negative.
            place = round(1e3 * shot.travelled_mm) % 2**32
            seed = int(np.random.SeedSequence([options.seed, _WALKS, place]).generate_state(1)[0])
            self._seen[light] = self._studio.electrons_per_ms(shot, spp=options.spp, seed=seed, travel=travel)
        return self._seen[light]


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

    A frame shows what the camera sees where the stage stands, with the laser as it is. A free-running camera exposes at
    its frame rate whatever rendering takes; its frames come later, with true time stamps. Camera and controller can be
    reached from this machine only.

    Parameters
    ----------
    sensor
        Name or path of the sensor description that the sensor's software will be given.
    placement
        Named place of the objects, such as near, standoff or far.
    effects
        Effects of real images to add, as for `simulate`, but for lamp-and-laser: the controller switches the laser.
        With camera-3d the camera's pixel format is Coord3D_C16 until a program sets Mono8.
    without
        Effects to leave out, as for `simulate`. A moving stage blurs the images of a free-running camera, not those of
        a triggered one.
    ideal
        Leave out all of these: a pinhole's sharp image without noise.
    stage_start
        Stage position in mm at which the scene's motion starts; the middle of the travel is used unless given. There
        the stage stands at first.
    lamp
        Whether the lamp is on while the laser is off; if the scene's motion has lamp images unless given.
    speed_up
        How much faster than real the stage moves.
    fault
        Faults as NAME[:ARGUMENT][@FRAME], each with the frame of that number, else with the first: drop, repeat or cut
        (so many frames), delay (s), camera-disconnect, stage-disconnect, mute, cut-line, stall, stop-short or
        lose-steps (steps), alarm (number), hold, restart, garbage, break-laser.
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
    options = Options.chosen(spp=spp, seed=seed, effects=effects, without=without, ideal=ideal)
    if options.flaws.lamp_and_laser:
        raise DescriptionError("lamp-and-laser cannot be served, as the controller switches the laser: leave it out")
    if not speed_up > 0:
        raise DescriptionError(f"speed_up is {speed_up:g}; it must be positive")
    motion = described.motion
    if not isinstance(motion, Motion):
        raise DescriptionError(f"{described.title} moves on a {motion.kind}; a stage is served: give steps of a stage")
    _, built = choose_sensors(sensor, as_built)
    faults = [parse_fault(text) for text in fault]
    use_variant(variant)
    from twin.recording.studio import Studio

    track = Track.on(built.stage, motion, start_mm=stage_start)
    lamp = "lamp" in motion.lights if lamp is None else lamp
    # The controller moves the stage, and a frame may ask for any light.
    at_rest = {"lights": ("lamp", "laser") if lamp else ("laser",), "speed_mm_per_s": 0.0}
    studio = Studio(built, altered(described, motion=at_rest), options)
    settings = {
        _STEPS_PER_MM: 1 / built.stage.resolution_mm,
        _SPEED: 60 * built.stage.speed_mm_per_s,
        _ACCELERATION: built.stage.acceleration_mm_per_s2,
        _TRAVEL: built.stage.travel_mm,
    }
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

    if studio.peak_finder is not None and built.camera.stripe_along != "width":
        raise DesignError("a 3D camera's profile lines are its columns: take a sensor with stripe_along = 'width'")

    def expose() -> ExposedFrame:
        state = controller.state()

        def image(exposure_ms: float) -> np.ndarray:
            number = next(numbers)
            inject(number, ahead=False)
            return bench.frame(exposure_ms, state)

        return ExposedFrame(state.time_s, controller.steps(state), image)

    camera = GigeCamera(
        frame,
        width_px=built.camera.width_px,
        height_px=built.camera.height_px,
        scan3d=studio.peak_finder,
        encoder=controller.steps,
        expose=expose,
    )
    inject(1, ahead=True)
    bench.prepare(studio.exposure_ms["laser"])
    with controller, camera:
        yield ServedTwin(controller, camera, track, studio.exposure_ms, lambda: bench.rates)
