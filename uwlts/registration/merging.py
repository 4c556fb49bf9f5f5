"""Merging of registered scans into one cloud, whose uncertainty includes that of the poses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from uwlts.registration.joint_registration import JointRegistration
from uwlts.storage.cloud import FOOTPRINT, FOOTPRINT_STD, NO_INDEX, PointCloud, PointUncertainty, rotate_covariances

_BLOCK = 50_000  # points, to limit memory
_LEFT_OUT = 1e-4  # largest fraction of the patterns' total variance in omitted patterns; it is 1 % of the rms shift


def merge_clouds(
    scans: Sequence[PointCloud], names: Sequence[str], joint: JointRegistration, covariance: np.ndarray
) -> PointCloud:
    """Merge all points in the common frame, corrected by the estimated pattern amplitudes.

    ``covariance`` (U, U) is that of all unknowns of the estimate. A scan without uncertainty receives that of its pose
    alone.
    """
    ends = np.cumsum([len(scan) for scan in scans])
    firsts = np.cumsum([0, *(1 + int(scan.frame.max(initial=-1)) for scan in scans[:-1])]).tolist()
    frames = [
        np.where(scan.frame == NO_INDEX, NO_INDEX, scan.frame + at) for scan, at in zip(scans, firsts, strict=True)
    ]
    points, random = np.empty((ends[-1], 3)), np.zeros((ends[-1], 6), np.float32)
    position = np.zeros((ends[-1], 3), np.float32)
    for number, scan in enumerate(scans):
        here, rotation = slice(ends[number] - len(scan), ends[number]), joint.poses[number, :3, :3]
        places, known = scan.points_mm, scan.uncertainty
        if known is not None:
            places = places + np.tensordot(joint.patterns[number], known.patterns_mm, axes=1)
            random[here] = rotate_covariances(known.random_mm2, rotation)
            position[here] = known.position_mm @ rotation.T
        points[here] = places @ rotation.T + joint.poses[number, :3, 3]
    patterns = _find_joint_patterns(scans, np.split(points, ends[:-1]), joint, covariance)
    times = [scan.time_s for scan in scans if scan.time_s is not None]
    return PointCloud(
        points_mm=points,
        intensity=np.concatenate([scan.intensity for scan in scans]),
        frame=np.concatenate(frames),
        line=np.concatenate([scan.line for scan in scans]),
        uncertainty=PointUncertainty(random, position, patterns, _rotate_image_poses(scans, joint)),
        time_s=np.concatenate(times) if len(times) == len(scans) else None,
        metadata=_merge_metadata(scans, names, joint, firsts),
    )


def _rotate_image_poses(scans: Sequence[PointCloud], joint: JointRegistration) -> np.ndarray | None:
    """Rotate the image-pose errors (K, N, 3) of all scans into the common frame; None if no scan has any."""
    known = [None if scan.uncertainty is None else scan.uncertainty.poses_mm for scan in scans]
    count = max((len(each) for each in known if each is not None), default=0)
    if not count:
        return None
    parts = [np.zeros((count, len(scan), 3), np.float32) for scan in scans]
    for number, each in enumerate(known):
        if each is not None:
            parts[number][: len(each)] = each @ joint.poses[number, :3, :3].T
    return np.concatenate(parts, axis=1)


def _find_joint_patterns(
    scans: Sequence[PointCloud], points: Sequence[np.ndarray], joint: JointRegistration, covariance: np.ndarray
) -> np.ndarray:
    """Return patterns (M, N, 3), orthogonal over all points, of the joint covariance of poses and patterns."""
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))

    def blocks() -> list[tuple[int, slice]]:
        return [(n, slice(k, k + _BLOCK)) for n, each in enumerate(points) for k in range(0, len(each), _BLOCK)]

    def shifts(number: int, here: slice) -> np.ndarray:
        """Shift (R, B, 3) of some points of a scan by the independent components of the covariance."""
        scan, columns = scans[number], joint.pose_columns[number]
        result = np.zeros((root.shape[1], len(points[number][here]), 3))
        if len(columns):
            about = points[number][here] - joint.middles_mm[number]
            by_shift, by_turn = root[columns[:3]].T, root[columns[3:]].T
            result += by_shift[:, None] + np.cross(by_turn[:, None], about[None])
        scan_columns = joint.pattern_columns[number]
        if len(scan_columns) and scan.uncertainty is not None:
            turned = scan.uncertainty.patterns_mm[:, here] @ joint.poses[number, :3, :3].T
            result += np.tensordot(root[scan_columns].T, turned, axes=1)
        return result

    gram = np.zeros((root.shape[1],) * 2)
    for number, here in blocks():
        flat = shifts(number, here).reshape(len(gram), -1)
        gram += flat @ flat.T
    strengths, ways = np.linalg.eigh(gram)
    strengths, ways = np.maximum(strengths[::-1], 0.0), ways[:, ::-1]
    left = 1 - np.cumsum(strengths) / max(strengths.sum(), 1e-300)
    count = 1 + int(np.argmax(left <= _LEFT_OUT))
    result = np.empty((count, sum(map(len, points)), 3), np.float32)
    of_scans = np.split(result, np.cumsum([len(each) for each in points])[:-1], axis=1)
    for number, here in blocks():
        of_scans[number][:, here] = np.tensordot(ways[:, :count].T, shifts(number, here), axes=1)
    return result


def _merge_metadata(
    scans: Sequence[PointCloud], names: Sequence[str], joint: JointRegistration, firsts: list[int]
) -> dict:
    """Collect the metadata that all scans share, and the name, pose and first image number of each scan."""
    shared = {
        key: value
        for key, value in scans[0].metadata.items()
        if key not in (FOOTPRINT, FOOTPRINT_STD) and all(scan.metadata.get(key) == value for scan in scans[1:])
    }
    listed = [
        {"name": name, "first_frame": first, "pose": pose.tolist()}
        for name, first, pose in zip(names, firsts, joint.poses, strict=True)
    ]
    return shared | {"scans": listed}
