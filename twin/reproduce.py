"""Records whole campaigns: every recording of each seed, several at a time, going on where an earlier run stopped."""

import json
import multiprocessing
import os
import queue
import signal
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from twin.campaign import Campaign, Take, takes
from twin.options import Options
from twin.variant import CPU, use_variant
from uwlts.capture import part_path
from uwlts.errors import DescriptionError, OutputError
from uwlts.files import written_aside
from uwlts.truth import truth_path

PLAN = "plan.json"


@dataclass(frozen=True)
class _Job:
    """A take to render into a file."""

    take: Take
    path: Path
    options: Options
    variant: str
    overwrite: bool


def record_campaigns(
    campaign: Campaign,
    folder: Path,
    *,
    seeds: range,
    every: int = 1,
    spp: int = 16,
    variant: str = CPU,
    workers: int | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Path]:
    """Render all recordings of a campaign for each seed into ``folder/campaign-SEED``; returns these folders.

    Complete recordings stay as they are and interrupted ones are gone on with; ``overwrite`` renders all anew.
    ``progress(done, total)`` counts images.

    Raises
    ------
    DescriptionError
        The folder holds a campaign that was rendered differently.
    OutputError
        A file cannot be written.
    """
    plan = {"campaign": campaign.model_dump(mode="json"), "every": every, "spp": spp, "variant": variant}
    _keep_to_plan(folder, plan, overwrite=overwrite)
    jobs, folders = [], [folder / f"campaign-{seed}" for seed in seeds]
    for seed, place in zip(seeds, folders, strict=True):
        place.mkdir(exist_ok=True)
        for take in takes(campaign, seed=seed, every=every):
            jobs.append(_Job(take, place / f"{take.name}.h5", Options(spp=spp, seed=take.seed), variant, overwrite))
    total = sum(map(_images, jobs))
    waiting = [job for job in jobs if overwrite or not _complete(job.path)]
    done = total - sum(map(_images, waiting))
    progress(done, total)
    if waiting:
        workers = min(len(waiting), workers or len(os.sched_getaffinity(0)))
        _render(waiting, workers, lambda images: progress(done + images, total))
    return folders


def _keep_to_plan(folder: Path, plan: dict[str, object], *, overwrite: bool) -> None:
    """Write down how a folder's campaigns are rendered, or make sure that it says the same."""
    path = folder / PLAN
    try:
        folder.mkdir(parents=True, exist_ok=True)
        known = None if overwrite or not path.is_file() else json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise OutputError(f"cannot use the folder {folder}: {error.strerror}") from error
    except ValueError as error:
        raise DescriptionError(f"{path} is damaged: {error}; give --overwrite to start afresh") from error
    if known is None:
        with written_aside(path, overwrite=overwrite) as aside:
            aside.write_text(json.dumps(plan, indent=2) + "\n", encoding="utf-8")
    elif known != json.loads(json.dumps(plan)):
        differing = ", ".join(key for key in plan if known.get(key) != json.loads(json.dumps(plan[key])))
        raise DescriptionError(
            f"{folder} holds campaigns that were rendered with another {differing}: give another folder, the same "
            "settings, or --overwrite to start afresh"
        )


def _complete(path: Path) -> bool:
    return path.is_file() and truth_path(path).is_file() and not part_path(path).exists()


def _images(job: _Job) -> int:
    motion = job.take.scene.motion
    return motion.count * len(motion.lights)


def _render(jobs: list[_Job], workers: int, progress: Callable[[int], None]) -> None:
    """Render jobs in processes of their own, the longest first; ``progress(images)`` counts those done."""
    context = multiprocessing.get_context("spawn")
    rendered, images = context.Queue(), 0
    with ProcessPoolExecutor(workers, context, _begin_worker, (rendered, workers)) as pool:
        futures = [pool.submit(_record, job) for job in sorted(jobs, key=_images, reverse=True)]
        try:
            while not all(future.done() for future in futures):
                failed = next((f for f in futures if f.done() and f.exception() is not None), None)
                if failed is not None:
                    failed.result()
                try:
                    rendered.get(timeout=0.2)
                    images += 1
                    progress(images)
                except queue.Empty:
                    pass
            for future in futures:
                future.result()
        except BaseException:
            # What has begun ends at its next image, and keeps those it has.
            pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                process.terminate()
            raise


_rendered: Any = None


def _begin_worker(rendered: Any, workers: int) -> None:
    """Set up a process that renders: Ctrl-C is the parent's business, and the cores are shared."""
    global _rendered
    _rendered = rendered
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _interrupt)
    os.environ.setdefault("OMP_NUM_THREADS", "1")


def _interrupt(*_: object) -> None:
    raise KeyboardInterrupt


def _record(job: _Job) -> None:
    use_variant(job.variant)
    import drjit as dr

    from twin.simulate import simulate

    dr.set_thread_count(1)
    done = 0

    def progress(images: int, total: int) -> None:
        nonlocal done
        for _ in range(images - done):
            _rendered.put(None)
        done = images

    # A capture without its truth was interrupted between the two.
    whole = job.path.exists() and not truth_path(job.path).exists()
    simulate(
        job.take.scene, job.take.sensor, job.path, as_built=job.take.built, options=job.options,
        overwrite=job.overwrite or whole, resume=part_path(job.path).exists() and not job.overwrite, progress=progress,
    )  # fmt: skip
