"""A mount as text for the terminal."""

import numpy as np
from scipy.spatial.transform import Rotation

from uwlts.model.mount import BoardFound, Mount, RingFound, SphereFound, StepFound


def mount_lines(mount: Mount) -> list[str]:
    """The transform with its 95 % intervals, the artefact, the scatter found, poses left out and the next pose."""
    half = mount.coverage_factor * mount.std()
    transform = mount.transform()
    rotation = Rotation.from_matrix(transform[:3, :3])
    used = [pose for pose in mount.poses if pose.reason is None]
    lines = ["T_platform_sensor (x y z of the sensor -> platform, mm):"]
    lines += ["  " + " ".join(f"{value:12.6f}" for value in row) for row in transform]
    lines += [
        f"  quaternion x y z w      {' '.join(f'{value:10.7f}' for value in rotation.as_quat())}",
        f"  Euler angles ZYX deg    {' '.join(f'{value:10.4f}' for value in rotation.as_euler('ZYX', degrees=True))}",
        f"translation, 95 % mm      {' '.join(f'+-{value:.3f}' for value in half[:3])}",
        f"rotation, 95 % deg        {' '.join(f'+-{value:.4f}' for value in np.degrees(half[3:]))}",
    ]
    found = mount.artefact
    if isinstance(found, BoardFound):
        x, y, z = (row[3] for row in found.T_base_target[:3])
        lines.append(f"target, mm                origin at {_vector((x, y, z))}")
    elif isinstance(found, SphereFound):
        known = "given" if found.radius_std_mm is None else f"+-{mount.coverage_factor * found.radius_std_mm:.3f}"
        lines.append(f"sphere, mm                at {_vector(found.centre_mm)}, radius {found.radius_mm:.3f} ({known})")
    elif isinstance(found, StepFound):
        known = "given" if found.height_std_mm is None else f"+-{mount.coverage_factor * found.height_std_mm:.3f}"
        place = f"normal {_vector(found.normal)}, distance {found.distance_mm:.3f} mm"
        lines.append(f"step                      {place}, height {abs(found.height_mm):.3f} mm ({known})")
    elif isinstance(found, RingFound):
        known = "given" if found.radius_std_mm is None else f"+-{mount.coverage_factor * found.radius_std_mm:.3f}"
        place = f"axis {_vector(found.axis)} through {_vector(found.centre_mm)}"
        lines.append(f"ring, mm                  {place}, radius {found.radius_mm:.3f} ({known})")
    else:
        lines.append(f"plane                     normal {_vector(found.normal)}, distance {found.distance_mm:.3f} mm")
    if mount.robot_scale is not None and mount.robot_scale_std is not None:
        half_scale = mount.coverage_factor * mount.robot_scale_std
        lines.append(f"robot's scale             {mount.robot_scale:.6f} +-{half_scale:.6f}")
    if mount.time_offset_s is not None and mount.time_offset_std_s is not None:
        half_time = mount.coverage_factor * mount.time_offset_std_s
        lines.append(f"time offset, s            {mount.time_offset_s:.5f} +-{half_time:.5f}")
    lines += [
        f"scatter found, mm         points {mount.point_std_mm:.4f}, positions of the platform {mount.pose_std_mm:.4f}",
        f"distances rms, mm         {mount.rms_mm:.4f}; of poses held out {mount.held_out_rms_mm:.4f}",
        f"poses used                {len(used)} of {len(mount.poses)}",
    ]
    lines += [f"  left out {pose.name}: {pose.reason}" for pose in mount.poses if pose.reason is not None]
    if (advised := mount.next_pose) is not None:
        lines.append(
            f"next pose                 {advised.words}: points known to {advised.after_mm:.4f} mm in place of "
            f"{advised.before_mm:.4f} mm"
        )
    return lines


def _vector(values: tuple[float, float, float]) -> str:
    return f"({', '.join(f'{value:.3f}' for value in values)})"
