"""Speed of design studies: evaluation by formulas, cost of the engine, and verification of a design by rendering."""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from twin.design.study import Study, load_study
from twin.design.sweep import Batch, evaluate_batch, read_parts, write_part
from uwlts.runtime.workers import map_in_threads, open_workers

WORKERS = 2
BATCHES, BATCH = 40, 1000
ALONE = """
import sys
from pathlib import Path

from twin.design.verification import verify
from uwlts.model.library import load_sensor

if __name__ == "__main__":
    verify(load_sensor("thesis"), "water", Path(sys.argv[1]) / "verified")
"""


def timed(batch: Batch) -> tuple[float, bytes]:
    """Return the processor time in s to evaluate a batch, and the part."""
    start = time.process_time()
    content = evaluate_batch(batch)
    return time.process_time() - start, content


def screening() -> tuple[float, float]:
    """Return designs per second (thesis's baseline and angle, two workers) and the engine's fraction of the time.

    The engine is everything except the evaluation of designs: distributing work, collecting results and writing the
    parts. The start of the workers is left out.
    """
    study = load_study("baseline-angle")
    sampling = {"kind": "sobol", "designs": BATCHES * BATCH, "batch": BATCH}
    study = Study.model_validate(study.model_dump() | {"sampling": sampling})
    batches = [Batch(study, None, first, BATCH) for first in range(0, BATCHES * BATCH, BATCH)]
    with tempfile.TemporaryDirectory() as folder, open_workers(workers=WORKERS) as pool:

        def write(judged: tuple[Batch, Any]) -> float:
            batch, (seconds, content) = judged
            write_part(Path(folder), batch.first, content)
            return seconds

        list(pool.map_unordered(timed, batches[: 2 * WORKERS]))
        start, judging = time.perf_counter(), 0.0
        for _, seconds in map_in_threads(write, pool.map_unordered(timed, batches)):
            judging += seconds
        wall = time.perf_counter() - start
        assert len(read_parts(Path(folder))["design"]) == BATCHES * BATCH
    return BATCHES * BATCH / wall, 1 - judging / (WORKERS * wall)


def verification() -> float:
    """Return the seconds to verify the thesis's sensor by rendering, including the start of Python."""
    with tempfile.TemporaryDirectory() as folder:
        # A file, since the processes that render begin by reading it.
        script = Path(folder) / "alone.py"
        script.write_text(ALONE, encoding="utf-8")
        environment = os.environ | {"PYTHONPATH": str(Path.cwd())}
        start = time.perf_counter()
        subprocess.run([sys.executable, str(script), folder], check=True, env=environment)
        return time.perf_counter() - start
