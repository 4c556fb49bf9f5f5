"""Reading of any file of the program; the content determines the type of the result."""

from pathlib import Path

from uwlts.errors import CaptureError
from uwlts.files.json_files import read_json
from uwlts.files.reading import require_regular_file
from uwlts.model.any_calibration import AnyCalibration
from uwlts.model.mount import FORMAT as MOUNT, Mount
from uwlts.model.trajectory import Trajectory
from uwlts.storage.calibration_file import FORMAT as CALIBRATION, POLYNOMIALS_FORMAT, load_calibration
from uwlts.storage.capture import FORMAT as CAPTURE, Capture
from uwlts.storage.cloud import PointCloud
from uwlts.storage.cloud_files import CLOUD_ENDINGS, is_cloud, read_cloud
from uwlts.storage.hdf5_file import format_of
from uwlts.storage.mount_files import read_mount
from uwlts.storage.pose_files import PoseFormat, Unit, read_trajectory
from uwlts.storage.truth import FORMAT as TRUTH, Truth, read_truth

_READABLE = (
    f"captures and ground truth (.h5), clouds ({', '.join(CLOUD_ENDINGS)}), calibrations and mounts (.json), "
    "trajectories (.csv, .tum, ROS bags)"
)


def read(
    path: str | Path, *, pose_format: PoseFormat = "quaternion-xyzw", pose_unit: Unit = "mm"
) -> Capture | PointCloud | Truth | AnyCalibration | Mount | Trajectory:
    """Read a file: an opened capture, a cloud, ground truth, a calibration, a mount or a trajectory, by what it is.

    Values per frame of a capture are read at once, images when they are asked for: ``capture[12]`` is a `Frame`. A
    recording that is still being written can be opened by its name ``NAME.part``. Close a capture, or use it in a
    ``with``.

    Parameters
    ----------
    path : str or Path
        The file.
    pose_format : str
        Format of a trajectory, as for `reconstruct`; by default that of `Trajectory.save`.
    pose_unit : {"mm", "m"}
        Unit of a trajectory's positions.

    Raises
    ------
    CaptureError
        The file is missing, damaged, of a newer version, or none that can be read.
    DescriptionError
        A trajectory is not of the format.

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
        found = read_json(path, called="file of this program").get("format")
        if found in (CALIBRATION, POLYNOMIALS_FORMAT):
            return load_calibration(path)
        if found == MOUNT:
            return read_mount(path)
        raise CaptureError(f"{path} is JSON of the format {found!r}; this reads {_READABLE}")
    if ending == ".csv":
        return read_trajectory(path, pose_format=pose_format, unit=pose_unit)
    if is_cloud(path):
        return read_cloud(path)
    if ending == ".h5":
        found = format_of(path)
        if found == TRUTH:
            return read_truth(path)[1]
        if found in (CAPTURE, None):
            return Capture(path)
        raise CaptureError(f"{path} is HDF5 of the format {found!r}; this reads {_READABLE}")
    raise CaptureError(f"{path} ends with {path.suffix or 'no ending'}; this reads {_READABLE}")
