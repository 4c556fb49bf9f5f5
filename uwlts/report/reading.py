"""Reading of any file of the program; the content determines the type of the result."""

from collections.abc import Callable
from pathlib import Path

from uwlts.acceptance.accept import FORMAT as ACCEPTANCE, Acceptance, read_acceptance
from uwlts.errors import CaptureError
from uwlts.evaluation.evaluate import FORMAT as EVALUATION, Evaluation, read_evaluation
from uwlts.files.json_files import read_json
from uwlts.files.reading import require_regular_file
from uwlts.model.any_calibration import AnyCalibration
from uwlts.model.mount import FORMAT as MOUNT, Mount
from uwlts.model.trajectory import Trajectory
from uwlts.storage.calibration_file import FORMAT as CALIBRATION, POLYNOMIALS_FORMAT, load_calibration
from uwlts.storage.capture import FORMAT as CAPTURE, Capture
from uwlts.storage.cloud import PointCloud
from uwlts.storage.cloud_files import CLOUD_ENDINGS, is_readable_cloud, read_cloud
from uwlts.storage.figure_table import FORMAT as FIGURES, FigureTable, read_figures
from uwlts.storage.hdf5_file import read_format
from uwlts.storage.mesh_file import READ_FORMATS as MESH_FORMATS, SurfaceMesh, has_faces, read_mesh
from uwlts.storage.mount_files import read_mount
from uwlts.storage.number_tables import Unit
from uwlts.storage.pose_files import SAVED_FORMAT, PoseFormat, holds_trajectory, read_trajectory
from uwlts.storage.truth import FORMAT as TRUTH, Truth, read_truth

_TABLES = (".csv", ".txt", ".asc")
"""Endings of text with a cloud or a trajectory."""
_Stored = AnyCalibration | Mount | Evaluation | Acceptance | FigureTable
_Readable = Capture | PointCloud | SurfaceMesh | Truth | Trajectory | _Stored
_JSON_READERS: dict[str, Callable[[Path], _Stored]] = {
    CALIBRATION: load_calibration,
    POLYNOMIALS_FORMAT: load_calibration,
    MOUNT: read_mount,
    EVALUATION: read_evaluation,
    ACCEPTANCE: read_acceptance,
    FIGURES: read_figures,
}
_READABLE = (
    f"captures and ground truth (.h5), clouds ({', '.join(CLOUD_ENDINGS)}), meshes ({', '.join(MESH_FORMATS)}), "
    "calibrations, mounts, acceptance tests, figures and evaluations (.json), trajectories (.csv, .tum, ROS bags)"
)


def read(
    path: str | Path, *, pose_format: PoseFormat = SAVED_FORMAT, pose_unit: Unit | None = None, unit: Unit | None = None
) -> _Readable:
    """Read a file of the program, whose content determines the type of the result.

    The result is of the class that was saved, or an opened capture. A PLY file with faces is a mesh, text with times
    and rotations a trajectory. The metadata of a capture's frames are read at once, and images on demand:
    ``capture[12]`` is a `Frame`. A recording in progress can be opened by its name ``NAME.part``. Close a capture, or
    use it as a context manager.

    Parameters
    ----------
    path : str or Path
        The file.
    pose_format : str
        Format of a trajectory, as for `reconstruct`; by default that of `Trajectory.save`.
    pose_unit : {"mm", "m"}, optional
        Unit of a trajectory's positions; by default that in the names of its columns, else mm.
    unit : {"mm", "m"}, optional
        As for `export`.

    Returns
    -------
    Capture, PointCloud, SurfaceMesh, Truth, Mount, Evaluation, Acceptance, FigureTable, Trajectory or a calibration
        An opened capture must be closed, or used in a ``with`` statement.

    Raises
    ------
    CaptureError
        The file is missing, damaged, of a newer version, or of an unknown kind.
    DescriptionError
        A trajectory does not have the format.

    Examples
    --------
    >>> uwlts.read("spheres.ply").points_mm.shape
    >>> with uwlts.read("spheres.h5") as capture:
    ...     images = [frame.image for frame in capture if frame.laser_on]
    """
    path = Path(path)
    if pose_format.partition(":")[0] in ("ros", "tum"):
        return read_trajectory(path, pose_format=pose_format, unit=pose_unit)
    require_regular_file(path)
    ending = next((each for each in reversed(path.suffixes) if each != ".part"), "")
    if ending == ".json":
        found = read_json(path, called="file of this program", check_seal=False).get("format")
        if (reader := _JSON_READERS.get(str(found))) is None:
            raise CaptureError(f"{path} is JSON of the format {found!r}; this reads {_READABLE}")
        return reader(path)
    if ending.lower() in _TABLES and (pose_format != SAVED_FORMAT or holds_trajectory(path)):
        return read_trajectory(path, pose_format=pose_format, unit=pose_unit)
    if ending.lower() in MESH_FORMATS and (ending.lower() != ".ply" or has_faces(path)):
        return read_mesh(path, unit=unit)
    if is_readable_cloud(path):
        return read_cloud(path, unit=unit)
    if ending == ".h5":
        found = read_format(path)
        if found == TRUTH:
            return read_truth(path)[1]
        if found in (CAPTURE, None):
            return Capture(path)
        raise CaptureError(f"{path} is HDF5 of the format {found!r}; this reads {_READABLE}")
    raise CaptureError(f"{path} ends with {path.suffix or 'no ending'}; this reads {_READABLE}")
