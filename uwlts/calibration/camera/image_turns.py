"""Images that are turned or mirrored against the sensor's description, by directions that are known in the camera."""

import numpy as np

from uwlts.errors import CalibrationError

# Descriptions are rough: from this angle on a direction that lies much closer to where turned images would put it is
# taken for that.
_LEAST_TURN, _MUCH_CLOSER = np.radians(20), 1 / 3
_TURNS = {
    "turned by 180 deg": np.array([-1.0, -1.0, 1.0]),
    "mirrored top to bottom": np.array([1.0, -1.0, 1.0]),
    "mirrored left to right": np.array([-1.0, 1.0, 1.0]),
}


def turned_like(found: np.ndarray, described: np.ndarray, *, either_way: bool = False) -> str:
    """How images are turned that explain a unit direction (3,) against the one described, in words; empty if none do.

    Camera frame. ``either_way`` is for normals, of which the opposite is the same plane's.
    """

    def angle(other: np.ndarray) -> float:
        cosine = float(found @ other)
        return float(np.arccos(np.clip(abs(cosine) if either_way else cosine, -1.0, 1.0)))

    off = angle(described)
    if off < _LEAST_TURN:
        return ""
    return " or ".join(how for how, flip in _TURNS.items() if angle(flip * described) < _MUCH_CLOSER * off)


def refuse_turned_travel(found: np.ndarray | None, described: np.ndarray) -> None:
    """Refuse a stage that moves the sensor (3,) as in turned images, against its described direction (3,).

    A board that looks the same in a mirror shows nothing of that itself. Both in the camera frame; None where poses do
    not follow a stage. Raises CalibrationError.
    """
    described = described / np.linalg.norm(described)
    if found is not None and (how := turned_like(found, described)):
        raise CalibrationError(
            f"by the target's poses the stage moves the sensor along {np.round(found, 2).tolist()} (camera: right, "
            f"down, ahead), by stage_direction along {np.round(described, 2).tolist()}, as it is where the images are "
            f"{how}: turn the images back, or correct stage_direction"
        )
