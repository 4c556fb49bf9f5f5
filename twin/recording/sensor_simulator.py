"""Simulation of a sensor in a scene: poses, exposures, noisy images, and the ground truth of each shot."""

from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np

from twin.light.illumination import reflect_ring
from twin.light.pose import Travel
from twin.light.renderer import Renderer
from twin.recording.frame_truth import (
    Crossings,
    FrameTruth,
    find_crossings,
    make_empty_truth,
    measure_line_light,
    select_brightest,
)
from twin.recording.image_formation import ImageFormation, ShotLight
from twin.rendering_options import Options
from twin.scene.description import PrintedPlate, Scene, medium_of, replace_values
from twin.scene.finish import shift_points
from twin.scene.platforms import Light, Platform, Shot
from twin.sensor.detector import as_built
from uwlts.errors import DesignError
from uwlts.model.placement import apparent_depth_mm, camera_from_object
from uwlts.model.sensor import Sensor
from uwlts.storage.capture import Frame

PROBE_SPP = 4
"""Samples per lit pixel of the images that determine the exposure, where an error of some percent is acceptable."""
BRIGHT_SHARE = 0.98
"""Quantile of the brightest pixel per profile line that automatic exposure uses; 2 % of the lines may be brighter."""
STRAY_LINES = 4  # number of brightest lines that may be due to single bright pixels
LIT_SHARE = 0.05  # a line is lit if it exceeds this fraction of the brightest line that is not one of `STRAY_LINES`


def with_window(sensor: Sensor, *, mounted: bool) -> Sensor:
    """Return the sensor with its camera window mounted or removed."""
    return replace_values(sensor, camera={"window": {"mounted": mounted}})


def check_scene(renderer: Renderer, scene: Scene) -> None:
    """Check that a scan reaches the objects.

    DesignError if the scene's stand-off or the objects are outside the depth range of the measuring volume, or the
    sheet never meets the objects. The scene's stand-off is the origin of its placement; a platform has none.
    """
    volume, axis = renderer.sensor.volume, camera_from_object(renderer.sensor)[:3, 2]
    # The sheet's centre line is along Z; outside the window, its camera depth is standoff + Z axis_z.
    nearest, farthest = ((edge - renderer.design.standoff_mm) / axis[2] for edge in (volume.near_mm, volume.far_mm))
    box = renderer.objects.scene.bbox()
    corners = np.array(list(product(*zip(box.min, box.max, strict=True))))
    inverse = np.linalg.inv([scene.motion.pose(shot) for shot in scene.motion.shots()])
    seen = np.einsum("sij,cj->sci", inverse[:, :3, :3], corners) + inverse[:, None, :3, 3]
    low, high = seen.min(axis=1), seen.max(axis=1)
    origin = (inverse @ scene.placements[scene.placement].matrix()[:, 3])[:, 2]
    if not isinstance(scene.motion, Platform) and not ((origin >= nearest) & (origin <= farthest)).any():
        low_mm, high_mm = (renderer.design.standoff_mm + axis[2] * z for z in (origin.min(), origin.max()))
        depth = f"{low_mm:.1f}" + (f" to {high_mm:.1f}" if high_mm - low_mm > 0.05 else "")
        raise DesignError(
            f"the stand-off of the scene '{scene.title}' (placement '{scene.placement}') is {depth} mm from the "
            f"camera's window, outside the measuring volume of the sensor '{renderer.sensor.name}' from "
            f"{volume.near_mm:g} to {volume.far_mm:g} mm: choose another placement, or set volume.near_mm and "
            "volume.far_mm about it"
        )
    if not ((low[:, 2] <= farthest) & (high[:, 2] >= nearest)).any():
        raise DesignError(
            f"the objects are at Z = {low[:, 2].min():.1f} to {high[:, 2].max():.1f} mm from the stand-off, outside "
            f"the measuring volume from {nearest:.1f} to {farthest:.1f} mm: choose another placement or volume"
        )
    if not ((low[:, 0] <= 0) & (high[:, 0] >= 0)).any():
        raise DesignError(
            f"the sheet never meets the objects: in the sensor's frame they stay between X = {low[:, 0].min():.1f} and "
            f"{high[:, 0].max():.1f} mm, but the sheet is at X = 0: change the motion or the objects' position"
        )


@dataclass(frozen=True)
class SimulatedImage:
    """A simulated image, and the mean photo-electrons (H, W), float32, of its exposure by light path.

    The light paths contain neither speckle nor noise.
    """

    image: np.ndarray  # (H, W); grey values
    exposure_ms: float
    direct: np.ndarray  # laser light from directly lit surfaces
    scattered_once: np.ndarray  # light that the water scatters once from the sheet into the camera's rays
    indirect: np.ndarray  # light that is scattered several times or reflected between surfaces
    particles: np.ndarray  # light of particles and bubbles in the sheet
    even: np.ndarray  # light of lamp and day

    def total(self) -> np.ndarray:
        """Return the sum of all light paths (H, W)."""
        return self.direct + self.scattered_once + self.indirect + self.particles + self.even


class SensorSimulator:
    """Simulator of a sensor in a scene; it determines the exposures when it is created.

    An automatic exposure follows from the first, middle and last shot of the ``scan``. With "middle", it follows from
    the middle shot alone, without speckle, if that shot shows any light.
    """

    def __init__(self, sensor: Sensor, scene: Scene, options: Options, *, probe: Literal["scan", "middle"] = "scan"):
        flaws, mounted = options.flaws, sensor.camera.window.mounted and scene.window_mounted
        self.sensor = as_built(with_window(sensor, mounted=mounted), flaws)
        self.scene, self.options = scene, options
        self.medium = medium_of(sensor, scene)
        self.renderer = Renderer(
            self.sensor, self.medium, scene, effects=options.effects, flaws=flaws, seed=options.seed
        )
        check_scene(self.renderer, scene)
        self.formation = ImageFormation(self.sensor, self.medium, options, window_mounted=mounted)
        self._lamp_ring = None
        if flaws.lamp_reflection and mounted:
            self._lamp_ring = reflect_ring(self.renderer.view, self.sensor, reflectance=flaws.lamp_reflection)
        self._crossings: tuple[Shot, Crossings] | None = None
        self._level_e = self.sensor.exposure.auto_level * self.sensor.detector.full_well_e
        self.exposure_ms = {light: self._find_exposure(light, probe) for light in dict.fromkeys(scene.motion.lights)}
        longest_ms = max(self.exposure_ms[shot.light] * shot.exposure for shot in scene.motion.shots())
        self.period_s = self._compute_period_s(max(1e-3 * longest_ms, 1 / self.sensor.detector.frame_rate_hz))

    def _compute_period_s(self, shortest_s: float) -> float:
        """Return the time between shots: motion or settling of the platform, exposure and read-out of the camera.

        DesignError if a moving platform leaves the camera less time than it needs.
        """
        motion = self.scene.motion
        if not motion.moves():
            return self.sensor.stage.settling_s + shortest_s
        if isinstance(motion, Platform):
            assert motion.frame_rate_hz is not None
            period_s = 1 / motion.frame_rate_hz
            pace = f"at {motion.frame_rate_hz:g} images/s the next image is due"
            advice = "reduce the frame rate"
        else:
            period_s = abs(motion.step_mm) / motion.speed_mm_per_s
            pace = f"at {motion.speed_mm_per_s:g} mm/s the next position, {abs(motion.step_mm):g} mm on, is reached"
            advice = "reduce the speed, increase the step"
        if motion.images() > 1 and period_s < shortest_s * (1 - 1e-9):
            raise DesignError(
                f"{pace} after {1e3 * period_s:.3g} ms, but the camera needs {1e3 * shortest_s:.3g} ms per frame: "
                f"{advice} or shorten the exposures"
            )
        return period_s

    def pose(self, shot: Shot) -> np.ndarray:
        """Return ``T_scene_object`` (4, 4) of the sensor's OCS at a shot, in the middle of its exposure."""
        return self.scene.motion.pose(shot)

    def travel(self, shot: Shot, *, in_water: bool = False) -> Travel | None:
        """Return the motion of the sensor in the scene, or relative to the water, during the exposure of a shot.

        None if it does not move.
        """
        motion, current = self.scene.motion, in_water * np.array(self.scene.current_mm_per_s)
        if not self.options.effects.motion or not (motion.moves() or current.any()):
            return None
        exposure_ms, velocity, turn = self._choose_exposure(shot), np.zeros(3), np.zeros(3)
        if motion.moves():
            velocity, turn = motion.twist(shot, exposure_s=1e-3 * exposure_ms)
        return self.travel_at(velocity - current, turn, exposure_ms=exposure_ms)

    def _choose_exposure(self, shot: Shot) -> float:
        """Return the exposure time of a shot in ms."""
        return self.exposure_ms[shot.light] * shot.exposure

    def travel_at(self, velocity_mm_s: np.ndarray, turn_rad_s: np.ndarray, *, exposure_ms: float) -> Travel:
        """Return a motion of the sensor during an exposure."""
        detector = self.sensor.detector
        row_s = 1e-6 * detector.line_time_us if detector.shutter == "rolling" else 0.0
        middle_row = (self.sensor.camera.height_px - 1) / 2
        return Travel(velocity_mm_s, 1e-3 * exposure_ms, turn_rad_s, row_s=row_s, middle_row=middle_row)

    def electrons_per_ms(self, shot: Shot, *, spp: int, seed: int, travel: Travel | None = None) -> np.ndarray:
        """Return the mean photo-electrons per ms (H, W) of a shot."""
        return self.formation.electrons_per_ms(self._render_light(shot, spp=spp, seed=seed, travel=travel), shot)

    def _render_light(
        self,
        shot: Shot,
        *,
        spp: int,
        seed: int,
        travel: Travel | None,
        through_water: Travel | None = None,
        time_s: float = 0.0,
        exposure_s: float = 0.0,
        with_truth: bool = False,
    ) -> ShotLight:
        others, pose = "lamp" if self.shows(shot, "lamp") else "day", self.pose(shot)
        even = self.renderer.irradiance(others, pose, spp=spp, travel=travel, time_s=time_s, exposure_s=exposure_s)
        if others == "lamp" and self._lamp_ring is not None:
            even = even + self._lamp_ring
        if not self.shows(shot, "laser"):
            return even, None
        lines = self._find_true_stripe(shot).surface_lines() if with_truth else None
        laser = self.renderer.laser_frame(
            pose, spp=spp, seed=seed, travel=travel, through_water=through_water, lines=lines
        )
        return even, laser

    def shows(self, shot: Shot, light: Light) -> bool:
        """Return whether the laser or the lamp is on in a shot."""
        return shot.light == light or (self.options.flaws.lamp_and_laser and shot.light != "day")

    def light(self, shot: Shot, index: int) -> ShotLight:
        """Return the light of image number ``index`` before the lens."""
        self._shift_points(shot, index)
        self._crossings = None
        seed = int(np.random.SeedSequence([self.options.seed, index]).generate_state(1)[0])
        return self._render_light(
            shot,
            spp=self.options.spp,
            seed=seed,
            travel=self.travel(shot),
            through_water=self.travel(shot, in_water=True),
            time_s=self._find_time_s(shot, index),
            exposure_s=1e-3 * self._choose_exposure(shot),
            with_truth=True,
        )

    def _find_time_s(self, shot: Shot, index: int) -> float:
        """Return the time of an image since the first of the scan."""
        return index * self.period_s if shot.time_s is None else shot.time_s

    def frame(self, shot: Shot, index: int) -> Frame:
        """Return image number ``index`` of the scan, with its metadata; noise depends only on seed, shot and index."""
        return self.frame_of(self.light(shot, index), shot, index)

    def frame_of(self, light: ShotLight, shot: Shot, index: int) -> Frame:
        """Return the frame of light from `light`.

        The renderer is not used, so it can render the next light meanwhile.
        """
        pose = covariance = None
        if isinstance(self.scene.motion, Platform):
            course = self.scene.motion.course()
            number = course.numbers[shot]
            pose = course.reported[number]
            covariance = None if course.covariance is None else course.covariance[number]
        exposure_ms = self._choose_exposure(shot)
        electrons = exposure_ms * self.formation.electrons_per_ms(light, shot)
        return Frame(
            self.formation.detect(electrons, exposure_ms=exposure_ms, noise_seed=[self.options.seed, index]),
            stage_mm=shot.stage_mm,
            laser_on=shot.light == "laser",
            exposure_ms=exposure_ms,
            time_s=self._find_time_s(shot, index),
            pose=pose,
            pose_covariance=covariance,
            speed_mm_per_s=self.scene.motion.stage_speed_mm_s(),
        )

    def expose(self, shot: Shot, index: int, *, exposure: float = 1.0, bright_share: float = 0.0) -> SimulatedImage:
        """Return the image of a shot as `frame` does, with its light; ``exposure`` multiplies the exposure time.

        An automatic exposure is shortened until at most ``bright_share`` (if not 0) of pixels exceed ``auto_level``.
        """
        even, laser = light = self.light(shot, index)
        per_ms, exposure_ms = self.formation.electrons_per_ms(light, shot), exposure * self._choose_exposure(shot)
        if bright_share > 0 and self.sensor.exposure.described_ms(shot.light) == "auto":
            exposure_ms = min(exposure_ms, self._level_e / max(float(np.quantile(per_ms, 1 - bright_share)), 1e-9))
        nothing = np.zeros_like(even)

        def to_electrons(part: np.ndarray, *, of_laser: bool) -> np.ndarray:
            if not part.any():
                return nothing
            mean = exposure_ms * self.formation.electrons_of_part(part, of_laser=of_laser)
            return np.maximum(mean, 0, dtype=np.float32)

        paths = [] if laser is None else [laser.direct(), laser.haze, laser.scattered - laser.haze, laser.particles]
        parts = [to_electrons(path, of_laser=True) for path in paths] or [nothing] * 4
        parts.append(to_electrons(even, of_laser=False))
        seed = [self.options.seed, index]
        image = self.formation.detect(exposure_ms * per_ms, exposure_ms=exposure_ms, noise_seed=seed)
        return SimulatedImage(image, exposure_ms, *parts)

    def truth(self, shot: Shot) -> FrameTruth:
        """Return the ground truth of every profile line of a shot."""
        if not self.shows(shot, "laser"):
            return make_empty_truth(self.sensor.camera.lines())
        return self.measure_line_light(shot, self._find_true_stripe(shot))

    def crossings(self, shot: Shot) -> Crossings:
        """Return all crossings of the sheet with surfaces in a shot; those of the last light are known."""
        if self._crossings is None or self._crossings[0] != shot:
            self._crossings = shot, find_crossings(self.renderer, self.pose(shot), travel=self.travel(shot))
        return self._crossings[1]

    def measure_line_light(self, shot: Shot, truth: FrameTruth) -> FrameTruth:
        """Return the truth of a shot with the light of its lines; see `twin.recording.frame_truth`."""
        pose, travel = self.pose(shot), self.travel(shot)
        return measure_line_light(self.renderer, pose, truth, spp=self.options.spp, travel=travel)

    def _find_true_stripe(self, shot: Shot) -> FrameTruth:
        """Return the truth of a shot without its light."""
        return select_brightest(self.crossings(shot), self.sensor.camera.lines())

    def _shift_points(self, shot: Shot, index: int) -> None:
        """Displace the points of a target by its detection errors in this image."""
        for plate, pose in zip(self.scene.objects, self.scene.object_poses(), strict=True):
            if isinstance(plate, PrintedPlate) and plate.detection_std_px > 0:
                depth_mm = (camera_from_object(self.sensor) @ np.linalg.inv(self.pose(shot)) @ pose)[2, 3]
                window, wavelength = self.sensor.camera.window, self.sensor.laser.wavelength_nm
                if window.mounted:
                    indices = {"glass_index": window.index(wavelength)}
                    indices["medium_index"] = self.medium.refractive_index(wavelength)
                    depth_mm = apparent_depth_mm(depth_mm, window.distance_mm, window.thickness_mm, **indices)
                mm_per_px = depth_mm / self.sensor.camera.focal_length_px()
                shift_points(self.renderer.objects.scene, plate, mm_per_px=mm_per_px, image=index)

    def _find_exposure(self, light: Light, probe: Literal["scan", "middle"]) -> float:
        """Return the described exposure in ms, or that which brings the brightest shot to the wanted level."""
        wanted = self.sensor.exposure.described_ms(light)
        if wanted != "auto":
            return wanted
        shots = [shot for shot in self.scene.motion.shots() if shot.light == light]
        axis = 0 if self.sensor.camera.stripe_along == "width" else 1
        brightest = 0.0
        for shot in dict.fromkeys((shots[len(shots) // 2], shots[0], shots[-1])):
            if probe == "middle" and brightest > 0:
                break
            rendered = self._render_light(shot, spp=PROBE_SPP, seed=0, travel=None)
            # If one shot suffices, skip its speckle, which would double the time.
            peaks = self.formation.electrons_per_ms(rendered, shot, speckle=probe == "scan").max(axis=axis)
            reference = np.sort(peaks)[-1 - min(STRAY_LINES, len(peaks) - 1)]
            lit = peaks[peaks > LIT_SHARE * reference]
            brightest = max(brightest, float(np.quantile(lit, BRIGHT_SHARE)) if len(lit) else 0.0)
        longest = self.sensor.exposure.longest_ms
        return min(longest, self._level_e / brightest) if brightest > 0 else longest
