"""Run readers on many mutated files: ``python -m tests.fuzz --cases 20000 capture``; by default, all readers.

A file that a reader neither reads nor rejects properly is stored in ``tests/fuzz/corpus`` as READER--NUMBER with its
suffix. The tests run all files of this folder. The exit code is 1 if there was such a file.
"""

import argparse
import shutil
import sys
import tempfile
import time
from pathlib import Path

from tests.fuzz.readers import READERS
from tests.fuzz.running import kept_file, watched

CORPUS = Path(__file__).with_name("corpus")
_MOST_KEPT = 5


def main() -> int:
    """Entry point."""
    options = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__.splitlines()[0])
    options.add_argument("readers", nargs="*", default=[], metavar="READER", help=", ".join(READERS))
    options.add_argument("--cases", type=int, default=5000, help="changed files for each reader (5000)")
    options.add_argument("--seed", type=int, default=int(time.time()), help="another number, other files (the time)")
    given = options.parse_args()
    if unknown := set(given.readers) - READERS.keys():
        options.error(f"unknown: {', '.join(unknown)}; known are {', '.join(READERS)}")
    names, began = given.readers or [*READERS], time.perf_counter()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        work = [(reader, str(number)) for reader in names for number in range(given.cases)]
        outcomes = watched(folder, work, seed=given.seed)
        for reader in names:
            of_it = [outcome for outcome in outcomes if outcome.reader == reader]
            faults = [outcome for outcome in of_it if outcome.fault]
            print(
                f"{reader:18} {len(of_it):6} cases, {sum(bool(outcome.refusal) for outcome in of_it):6} refused, "
                f"{sum(outcome.seconds for outcome in of_it):6.1f} s, longest "
                f"{max(outcome.seconds for outcome in of_it):.2f} s, most memory "
                f"{max(outcome.mib for outcome in of_it):.0f} MiB, {len(faults)} failed"
            )
            for fault in faults[:_MOST_KEPT]:
                kept = CORPUS / f"{reader}--{given.seed}-{fault.case}{READERS[reader].suffix}"
                shutil.copyfile(kept_file(folder, reader, fault.case), kept)
                print(f"  {kept.name}: {fault.fault[-700:]}")
    failed = sum(bool(outcome.fault) for outcome in outcomes)
    seconds = time.perf_counter() - began
    print(f"seed {given.seed}: {len(outcomes)} cases in {seconds:.0f} s, {failed} failed")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
