"""Linear guide and rotary table, with the error motions of their standards."""

from collections.abc import Callable
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator
from scipy.spatial.transform import Rotation

from twin.scene.platforms import SPOT_MM, Platform, PlatformMotion, Route, displace_poses
from twin.scene.scene_object import Pose
from uwlts.model.sensor import NotNegative, Positive


class LinearGuide(Route):
    """A linear guide from the first to the last waypoint, with the error motions of ISO 230-1:2012, 3.4.

    Error motions are ranges over the travel, in um of the carriage (the platform's origin) and in arcsec of its
    rotation. X is the guide's axis, and Z is as close to the scene's Z as possible. ``positioning_um`` (EXX) is along
    the guide and ``straightness_um`` is across it (EYX) and perpendicular to both (EZX); ``roll``, ``pitch`` and
    ``yaw`` are EAX, EBX, ECX. Each is a sum of waves of 1 to 4 periods over the travel, as bent rails cause. A screw of
    ``pitch_mm`` adds a periodic error with the amplitude ``periodic_um`` to EXX. The encoder reports the nominal
    position.
    """

    kind: Literal["linear_guide"]
    positioning_um: NotNegative = 0.0
    straightness_um: tuple[NotNegative, NotNegative] = (0.0, 0.0)
    roll_arcsec: NotNegative = 0.0
    pitch_arcsec: NotNegative = 0.0
    yaw_arcsec: NotNegative = 0.0
    periodic_um: NotNegative = 0.0
    pitch_mm: Positive = 5.0

    @model_validator(mode="after")
    def _is_straight(self) -> "LinearGuide":
        places = np.array([waypoint.position_mm for waypoint in self.waypoints])
        if len(places) < 2 or np.linalg.norm(places[-1] - places[0]) < SPOT_MM:
            raise ValueError("a linear guide needs two or more waypoints; the last must differ from the first")
        return self

    def draw_motion(self, rng: np.random.Generator) -> PlatformMotion:
        commanded = self.command_poses()
        first, last = (self.waypoints[end].matrix()[:3, 3] for end in (0, -1))
        travel = float(np.linalg.norm(last - first))
        guide = _axes((last - first) / travel)
        ranges = np.array([self.positioning_um, *self.straightness_um]) * 1e-3
        turns = np.radians(np.array([self.roll_arcsec, self.pitch_arcsec, self.yaw_arcsec]) / 3600)
        bends = [_bend(size, rng) for size in (*ranges, *turns)]
        begun, phase = commanded(np.zeros(1))[0, :3, 3], rng.uniform(0, 2 * np.pi)

        def true(times: np.ndarray) -> np.ndarray:
            poses = commanded(times)
            along = (poses[:, :3, 3] - begun) @ guide[:, 0]
            errors = np.stack([bend(along / travel) for bend in bends], axis=1)
            errors[:, 0] += 1e-3 * self.periodic_um * np.sin(2 * np.pi * along / self.pitch_mm + phase)
            return displace_poses(poses, np.hstack([errors[:, :3] @ guide.T, errors[:, 3:] @ guide.T]))

        return PlatformMotion(true, commanded)


class RotaryTable(Platform):
    """A rotary table that carries the scene's objects, in their frame: the sensor rotates in the opposite sense.

    The platform's frame is ``axis`` at angle 0, with z along the table's axis; ``true_axis`` is the true axis of
    rotation. Images are taken at ``count`` angles from ``start_deg`` over ``turn_deg``, at rest or at
    ``speed_deg_per_s``. The table reports its angle.

    The error motions of the axis (ISO 230-7:2015) are amplitudes at one cycle per turn, with a third of them at two
    cycles: ``radial_um`` (EXC, EYC), ``axial_um`` (EZC) and the wobble ``tilt_arcsec`` (EAC, EBC). The error of the
    scale is ``angle_arcsec`` (ECC), as caused by an eccentric graduation.
    """

    kind: Literal["rotary_table"]
    axis: Pose = Pose()
    true_axis: Pose | None = None
    start_deg: float = 0.0
    turn_deg: float = 360.0
    count: Annotated[int, Field(ge=1, le=100_000)]
    speed_deg_per_s: NotNegative = 0.0
    radial_um: NotNegative = 0.0
    axial_um: NotNegative = 0.0
    tilt_arcsec: NotNegative = 0.0
    angle_arcsec: NotNegative = 0.0

    @model_validator(mode="before")
    @classmethod
    def _derive_frame_rate(cls, table: object) -> object:
        """Derive the frame rate from speed and angles."""
        if not isinstance(table, dict) or not table.get("speed_deg_per_s") or table.get("frame_rate_hz") is not None:
            return table
        steps = max(int(table.get("count", 2)) - 1, 1)
        turn = abs(float(table.get("turn_deg", 360.0))) or 360.0
        return table | {"frame_rate_hz": float(table["speed_deg_per_s"]) * steps / turn}

    @property
    def stops(self) -> bool:
        return self.speed_deg_per_s == 0

    def places(self) -> int:
        return self.count

    def draw_motion(self, rng: np.random.Generator) -> PlatformMotion:
        nominal, true_axis = self.axis.matrix(), (self.true_axis or self.axis).matrix()
        sizes = np.array([self.radial_um, self.radial_um, self.axial_um]) * 1e-3
        tilt, scale = np.radians(self.tilt_arcsec / 3600), np.radians(self.angle_arcsec / 3600)
        phases = rng.uniform(0, 2 * np.pi, (6, 2))

        def angle(times: np.ndarray) -> np.ndarray:
            if self.stops:
                step = self.turn_deg / max(self.count - 1, 1)
                place = np.clip(np.floor(times / self.stop_s + 1e-9), 0, self.count - 1)
                return np.radians(self.start_deg + step * place)
            return np.radians(self.start_deg + np.sign(self.turn_deg) * self.speed_deg_per_s * times)

        def turned(axis: np.ndarray, by: np.ndarray, errors: np.ndarray | None) -> np.ndarray:
            local = np.tile(np.eye(4), (len(by), 1, 1))
            local[:, :3, :3] = Rotation.from_rotvec(np.outer(-by, (0, 0, 1))).as_matrix()
            if errors is not None:
                # The error motion of the table with the objects, in the frame of the fixed axis.
                table = np.tile(np.eye(4), (len(by), 1, 1))
                table[:, :3, :3] = Rotation.from_rotvec(errors[:, 3:]).as_matrix()
                table[:, :3, 3] = errors[:, :3]
                local = local @ np.linalg.inv(table)
            return axis @ local

        def true(times: np.ndarray) -> np.ndarray:
            by = angle(times)
            waves = np.sin(by[:, None, None] * (1, 2) + phases) @ (1, 1 / 3)
            return turned(true_axis, by, waves * (*sizes, tilt, tilt, scale))

        return PlatformMotion(true, lambda times: turned(nominal, angle(times), None))


def _axes(along: np.ndarray) -> np.ndarray:
    """Return axes (3, 3), in columns, with x along a direction and z as close to the scene's Z as possible."""
    up = np.array([0.0, 0.0, 1.0]) if abs(along[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    across = np.cross(up, along)
    across /= np.linalg.norm(across)
    return np.column_stack([along, across, np.cross(along, across)])


def _bend(size: float, rng: np.random.Generator) -> Callable[[np.ndarray], np.ndarray]:
    """Return an error motion over the travelled fraction, 0 to 1, with a given range.

    It consists of waves of 1 to 4 periods with amplitudes that decrease as 1/n.
    """
    orders = np.arange(1, 5)
    weights, phases = rng.standard_normal(4) / orders, rng.uniform(0, 2 * np.pi, 4)

    def raw(share: np.ndarray) -> np.ndarray:
        return np.sin(2 * np.pi * np.multiply.outer(share, orders) + phases) @ weights

    over = raw(np.linspace(0, 1, 201))
    scale = size / float(np.ptp(over))
    return lambda share: scale * (raw(share) - over[0])
