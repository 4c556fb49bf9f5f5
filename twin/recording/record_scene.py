"""Recording of a scene into a capture, with ground truth and the platform's trajectory in files beside it."""

import os
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import fields
from importlib.metadata import version
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from twin.backend.llvm import preserve_threads
from twin.recording.frame_truth import FrameTruth, find_visible_surfaces
from twin.recording.image_formation import ShotLight
from twin.recording.sensor_simulator import SensorSimulator, with_window
from twin.rendering_options import Options
from twin.scene.description import Scene, medium_of
from twin.scene.platforms import Platform, Shot
from uwlts.errors import OutputError
from uwlts.model.sensor import Sensor, Table, to_rows
from uwlts.model.trajectory import Trajectory
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.storage.capture import CaptureHeader
from uwlts.storage.capture_writer import CaptureWriter
from uwlts.storage.pose_files import trajectory_path
from uwlts.storage.truth import Truth, TruthHeader, scene_digest, truth_path, write_truth


def record_scene(
    scene: Scene,
    sensor: Sensor,
    path: str | Path,
    *,
    as_built: Sensor | None = None,
    options: Options = Options(),
    overwrite: bool = False,
    resume: bool = False,
    progress: ProgressListener = ignore_progress,
) -> None:
    """Render a scene into a capture, which states ``sensor``, and its ground truth into a file beside it.

    The images show the sensor ``as_built``, by default ``sensor``. An interrupted run leaves ``path.part`` with all
    complete frames; ``resume`` continues it, with the same result as an uninterrupted one. ``progress(done, total)``
    counts frames.

    Raises DesignError or DescriptionError if sensor or scene cannot work, and OutputError if a file exists or cannot be
    written.
    """
    path, motion = Path(path), scene.motion
    report = motion.course().report if isinstance(motion, Platform) else None
    for beside in (truth_path(path), *([] if report is None else [trajectory_path(path)])):
        if beside.exists() and not (overwrite or resume):
            raise OutputError(f"{beside} exists already; give another name, or `overwrite` to replace it")
    simulator = SensorSimulator(as_built or sensor, scene, options)
    drawn: Table = {"seed": options.seed, "spp": options.spp}
    # The header contains only what an operator knows: nominal values.
    header = CaptureHeader(
        name=path.stem,
        sensor=with_window(sensor, mounted=simulator.sensor.camera.window.mounted),
        medium_name=scene.medium,
        medium=medium_of(sensor, scene),
        stage_direction=(1.0, 0.0, 0.0) if isinstance(motion, Platform) else motion.recorded_direction(),
        T_platform_sensor=to_rows(motion.mount.matrix()) if isinstance(motion, Platform) else None,
        saturation_dn=sensor.detector.full_scale_dn(),
        target=scene.target,
        artefact=scene.artefact,
        provenance={
            "source": "twin",
            "scene": scene_digest(scene.model_dump(mode="json")),
            **drawn,
            "effects": [*simulator.options.names()],
            "variant": mi.variant(),
            **{package: version(package) for package in ("mitsuba", "drjit", "uwlts")},
        },
    )
    shots, truths = list(scene.motion.shots()), list[FrameTruth]()
    dtype = np.dtype(np.uint8 if sensor.detector.bits == 8 else np.uint16)
    # The true values must not be known to the evaluation, so the finished capture does not contain the plan.
    built = simulator.sensor
    plan: Table = {"scene": scene.model_dump(mode="json"), "as_built": built.model_dump(mode="json"), **drawn}
    covariances = isinstance(motion, Platform) and motion.states_covariance
    kinds = {"moving": motion.stage_speed_mm_s() != 0, "covariances": covariances}
    with (
        CaptureWriter(path, header, dtype=dtype, **kinds, plan=plan, overwrite=overwrite, resume=resume) as writer,
        ThreadPoolExecutor(1) as camera,
        preserve_threads() as threads,
    ):
        done = len(writer)

        def take(light: ShotLight, shot: Shot, index: int) -> None:
            writer.append(simulator.frame_of(light, shot, index))
            # This processor is free until the next image: kernels that are running now use it too.
            dr.set_thread_count(threads)

        def end(index: int, taken: Future[None] | None) -> None:
            if taken is not None:
                taken.result()
            progress(index + 1, len(shots))

        # Expose and write an image while the light of the next one is rendered.
        before: Future[None] | None = None
        for index, shot in enumerate(shots):
            # The light first: the truth uses the stripe's position that it found.
            light = simulator.light(shot, index) if index >= done else None
            truths.append(simulator.truth(shot))
            if index > 0:
                end(index - 1, before)
            before = None
            if light is not None:
                # The many small kernels of a laser image would take the processor from the camera's thread; a lamp
                # image has few large ones.
                lamp_next = shots[min(index + 1, len(shots) - 1)].light == "lamp"
                dr.set_thread_count(threads if lamp_next else min(threads, max(1, (os.cpu_count() or 1) - 1)))
                before = camera.submit(take, light, shot, index)
        end(len(shots) - 1, before)
        if report is not None:
            Trajectory(*report).save(trajectory_path(path), overwrite=overwrite or resume)
        described = TruthHeader(sensor=simulator.sensor, medium=simulator.medium, scene=scene.model_dump(mode="json"))
        truth = truth_of_recording(simulator, truths, shots)
        write_truth(truth_path(path), described, truth, overwrite=overwrite or resume)


def truth_of_recording(simulator: SensorSimulator, truths: Sequence[FrameTruth], shots: Sequence[Shot]) -> Truth:
    """Combine the truths of a recording's frames, with the depth map of the first shot."""
    stacked = {f.name: np.stack([getattr(truth, f.name) for truth in truths]) for f in fields(FrameTruth)}
    poses = np.stack([simulator.pose(shot) for shot in shots])
    return Truth(**stacked, depth_mm=find_visible_surfaces(simulator.renderer, poses[0])[0], pose=poses)
