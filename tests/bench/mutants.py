"""Mutation testing, the fraction of small faults that tests detect: ``python -m tests.bench.mutants [package ...]``.

Mutants of each package are drawn at random with Cosmic Ray's operators: another arithmetic operator, comparison, sign,
number or truth value, or a loop left out. Not changed is what has no effect on results: annotations, options of
dataclasses, and ``strict`` of ``zip``. Each mutant is tested in a copy of the checkout:
first with the tests that run the changed line, shortest first, then with the other tests of their files. Slow tests
are left out. ``--whole`` runs all fast tests of the package instead, which takes less time for few mutants.
``--again FILE`` runs all tests on the survivors of earlier results. A mutant survives if no test fails;
the reader decides if it changes a result at all. Needs ``pip install -e '.[mutants]'``.
"""

import argparse
import ast
import json
import random
import shutil
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from queue import SimpleQueue

from rich.console import Console
from rich.progress import track

from docs.studies.result_tables import publish, table

ROOT = Path(__file__).resolve().parents[2]
ALSO = {
    "uwlts/calibration/joint": ["tests/uwlts/calibration", "tests/uwlts/reconstruction"],
    "uwlts/calibration/mount": ["tests/uwlts/calibration/mount"],
    "uwlts/cli": [f"tests/system/test_{name}.py" for name in ("command_lines", "command_errors", "inputs_kept")],
    "uwlts/evaluation": ["tests/uwlts/reconstruction/test_point_uncertainty.py"],
    "uwlts/fitting": [f"tests/uwlts/{name}" for name in ("shapes", "evaluation", "registration", "inspection")],
    "uwlts/optics": [f"tests/uwlts/{name}" for name in ("reconstruction", "calibration", "thesis")],
    "uwlts/reconstruction": ["tests/uwlts/report", "tests/system/test_joint_command.py"],
    "uwlts/shapes": ["tests/uwlts/evaluation"],
    "uwlts/stripe": ["tests/uwlts/reconstruction"],
    "twin/devices": ["tests/system/test_serve.py", "tests/system/test_gige_camera.py", "tests/uwlts/hardware"],
    "twin/light": ["tests/twin/recording"],
    "twin/sensor": ["tests/twin/light"],
}
"""Tests of a package beside those of the same name."""
PACKAGES = sorted({*ALSO, *(str(init.parent.relative_to(ROOT)) for init in ROOT.glob("[tu]w*/*/__init__.py"))})
TESTS = {
    name: [*([f"tests/{name}"] if (ROOT / "tests" / name).is_dir() else []), *ALSO.get(name, [])] for name in PACKAGES
}
"""Packages, without packages within them that are listed too, and folders of the tests that run them."""
# These change no result, or make every test fail, such as bitwise operators between floating-point numbers.
_LEFT_OUT = {"NoOp", "RemoveDecorator", "ExceptionReplacer", "VariableReplacer", "VariableInserter"}
_BITWISE = {"BitAnd", "BitOr", "BitXor", "LShift", "RShift"}
_LONGEST_S = 240.0  # of the tests for one mutant


@dataclass(frozen=True)
class Mutant:
    """A changed line; ``occurrence`` counts the places in the file where Cosmic Ray's ``operator`` applies."""

    package: str
    file: str
    line: int
    operator: str
    occurrence: int

    def code(self, source: str) -> str:
        """The file's text with the change."""
        # Late, here and below: the help does not need the libraries.
        from cosmic_ray.mutating import mutate_code
        from cosmic_ray.plugins import get_operator

        return mutate_code(source, get_operator(f"core/{self.operator}")(), self.occurrence)


@dataclass(frozen=True)
class Result:
    """Fate of a mutant: ``killed``, ``survived`` or ``not run`` by any test; the line before and after the change."""

    mutant: Mutant
    outcome: str
    before: str
    after: str


def places_without_effect(source: str) -> set[tuple[int, int]]:
    """Line and column of the options of dataclasses and of ``strict``."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call):
            names = {"eq", "frozen", "repr", "kw_only"} if ast.unparse(node.func) == "dataclass" else {"strict"}
            found |= {(each.value.lineno, each.value.col_offset) for each in node.keywords if each.arg in names}
    return found


def annotated_lines(source: str) -> set[tuple[int, int]]:
    """Line and column of everything within annotations of types."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        for name in ("annotation", "returns"):
            if (annotation := getattr(node, name, None)) is not None:
                found |= {(each.lineno, each.col_offset) for each in ast.walk(annotation) if isinstance(each, ast.expr)}
    return found


def drawn(package: str, number: int, rng: random.Random) -> list[Mutant]:
    """Draw ``number`` mutants of a package, at most one from each place."""
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.plugins import get_operator, operator_names

    places: dict[tuple[str, int, int], list[Mutant]] = {}
    within = [ROOT / other for other in TESTS if other.startswith(f"{package}/")]
    for path in sorted((ROOT / package).rglob("*.py")):
        if any(path.is_relative_to(other) for other in within):
            continue
        source, file = path.read_text(), str(path.relative_to(ROOT))
        annotated, unchanged, tree = annotated_lines(source), places_without_effect(source), get_ast(source)
        for name in operator_names():
            short = name.removeprefix("core/")
            kind, *between = short.split("_")
            mixed = kind == "ReplaceBinaryOperator" and len(_BITWISE & set(between)) == 1
            if short in _LEFT_OUT or mixed:
                continue
            operator = get_operator(name)()
            positions = [at for node in ast_nodes(tree) for at in operator.mutation_positions(node)]
            for occurrence, ((line, column), _) in enumerate(positions):
                in_annotation = any(at[0] == line and abs(at[1] - column) <= 40 for at in annotated)
                if not (in_annotation and "BitOr" in short) and (line, column) not in unchanged:
                    places.setdefault((file, line, column), []).append(Mutant(package, file, line, short, occurrence))
    chosen = rng.sample(sorted(places), min(number, len(places)))
    return [rng.choice(places[place]) for place in chosen]


def copied(folder: Path) -> Path:
    """Copy the current files of the checkout, without those ignored by Git, except for Numba's compiled functions."""
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    )
    compiled = (path for top in ("uwlts", "twin") for path in (ROOT / top).rglob("__pycache__/*.nb[ci]"))
    for name in (*listed.stdout.splitlines(), *(str(path.relative_to(ROOT)) for path in compiled)):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)
    return folder


@dataclass(frozen=True)
class Tests:
    """Tests by the lines and files that they run, and their durations in ``seconds``."""

    of_line: dict[tuple[str, int], set[str]]
    of_file: dict[str, set[str]]
    seconds: dict[str, float]

    @classmethod
    def observed(cls, folder: Path, package: str, *, slow: bool, workers: int) -> "Tests":
        """Run a package's tests once."""
        from coverage import CoverageData

        report = folder / "report.xml"
        options = [f"--cov={package}", "--cov-context=test", "--cov-report=", f"--junitxml={report}"]
        options += [] if slow else ["-m", "not slow"]
        subprocess.run(
            [
                *_pytest(),
                *options,
                "-o",
                "junit_family=xunit1",
                "-n",
                str(workers),
                "--dist",
                "loadfile",
                *TESTS[package],
            ],
            cwd=folder,
            check=True,
            stdout=subprocess.DEVNULL,
        )
        seconds: dict[str, float] = {}
        for case in ElementTree.parse(report).getroot().iter("testcase"):
            seconds[f"{case.get('file')}::{case.get('name')}"] = float(case.get("time", 0))
        data = CoverageData(str(folder / ".coverage"))
        data.read()
        of_line: dict[tuple[str, int], set[str]] = {}
        of_file: dict[str, set[str]] = {}
        for path in data.measured_files():
            file = str(Path(path).relative_to(folder))
            for line, contexts in data.contexts_by_lineno(path).items():
                for context in filter(None, contexts):
                    test, phase = context.rsplit("|", 1)
                    # A fixture may be used by any test of the file.
                    tests = {test} if phase == "run" else {t for t in seconds if t.startswith(test.split("::")[0])}
                    of_line.setdefault((file, line), set()).update(tests)
                    of_file.setdefault(file, set()).update(tests)
        return cls(of_line, of_file, seconds)

    def chosen(self, mutant: Mutant, lines: Sequence[int]) -> Iterator[str]:
        """Yield tests for a mutant: of its statement's lines, or of its file if only the import runs them."""
        first: set[str] = set().union(*(self.of_line.get((mutant.file, line), set()) for line in lines))
        first = first or self.of_file.get(mutant.file, set())
        files = {test.split("::")[0] for test in first}
        beside = {test for test in self.seconds if test.split("::")[0] in files} - first
        left = _LONGEST_S
        for tests in (first, beside):
            for test in sorted(tests & self.seconds.keys(), key=lambda t: self.seconds[t]):
                left -= self.seconds[test]
                if left < 0:
                    return
                yield test


def statement_lines(source: str, line: int) -> range:
    """Return the lines of the smallest statement that contains a line, without the body of a compound statement."""
    best = range(line, line + 1)
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.stmt) and node.lineno <= line <= (node.end_lineno or line):
            body = getattr(node, "body", None)
            end = body[0].lineno - 1 if body else node.end_lineno or line
            if line <= end:
                best = range(node.lineno, end + 1)
    return best


def tried(mutant: Mutant, folder: Path, tests: Tests | None) -> Result:
    """Change the file in a copy of the checkout, run the tests (default: the package's fast ones), and put it back."""
    path = folder / mutant.file
    source = path.read_text()
    changed = mutant.code(source)
    before, after = (text.splitlines()[mutant.line - 1].strip() for text in (source, changed))
    if tests is None:
        chosen, limit = ["-m", "not slow", *TESTS[mutant.package]], 4 * _LONGEST_S
    else:
        chosen = list(tests.chosen(mutant, statement_lines(source, mutant.line)))
        limit = 60 + 5 * sum(tests.seconds[test] for test in chosen)
    if not chosen:
        return Result(mutant, "not run", before, after)
    path.write_text(changed)
    try:
        done = subprocess.run(
            [*_pytest(), "-x", *chosen], cwd=folder, timeout=limit, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        outcome = "killed" if done.returncode else "survived"
    except subprocess.TimeoutExpired:
        outcome = "killed"
    finally:
        path.write_text(source)
    return Result(mutant, outcome, before, after)


def _pytest() -> list[str]:
    return [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--hypothesis-seed=0"]


def of_package(
    package: str, mutants: list[Mutant], *, slow: bool, whole: bool, workers: int, console: Console
) -> Iterator[Result]:
    """Try mutants of a package, one result after the other."""
    with tempfile.TemporaryDirectory() as temporary:
        folders: SimpleQueue[Path] = SimpleQueue()
        for worker in range(workers):
            folders.put(copied(Path(temporary) / str(worker)))
        if whole:
            tests = None
        else:
            tests = Tests.observed(copied(Path(temporary) / "observed"), package, slow=slow, workers=workers)

        def one(mutant: Mutant) -> Result:
            folder = folders.get()
            try:
                return tried(mutant, folder, tests)
            finally:
                folders.put(folder)

        with ThreadPoolExecutor(workers) as pool:
            yield from track(pool.map(one, mutants), package, total=len(mutants), console=console)


def read(path: Path) -> list[Result]:
    """Read results stored by `main`."""
    return [Result(**each | {"mutant": Mutant(**each["mutant"])}) for each in json.loads(path.read_text())]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench.mutants", description=__doc__.splitlines()[0])
    parser.add_argument("packages", nargs="*", metavar="package", help=", ".join(TESTS))
    parser.add_argument("--sample", type=int, default=60, help="mutants of each package (default: 60)")
    parser.add_argument("--seed", type=int, default=0, help="draw others by another number")
    parser.add_argument("--whole", action="store_true", help="run all fast tests of the package for each mutant")
    parser.add_argument("--again", type=Path, help="try the survivors of these results on all tests")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--write", action="store_true", help="put the table into its page of docs/results")
    parser.add_argument("--out", type=Path, default=Path("mutants.json"), help="results, written after each mutant")
    options = parser.parse_args()
    if unknown := set(options.packages) - TESTS.keys():
        parser.error(f"no tests are named for {', '.join(sorted(unknown))}: choose from {', '.join(TESTS)}")
    console, results = Console(), read(options.again) if options.again else []
    for package in options.packages or TESTS:
        if options.again:
            mutants = [each.mutant for each in results if each.mutant.package == package and each.outcome != "killed"]
        else:
            mutants = drawn(package, options.sample, random.Random(f"{options.seed} {package}"))
        slow = options.again is not None
        for result in of_package(
            package, mutants, slow=slow, whole=options.whole, workers=options.workers, console=console
        ):
            results = [each for each in results if each.mutant != result.mutant] + [result]
            options.out.write_text(json.dumps([asdict(each) for each in results], indent=1))
    rows = []
    for package in [*dict.fromkeys(result.mutant.package for result in results), "together"]:
        count = Counter(result.outcome for result in results if package in (result.mutant.package, "together"))
        numbers = [count.total(), *(count[outcome] for outcome in ("killed", "survived", "not run"))]
        rows.append([package, *map(str, numbers), f"{count['killed'] / count.total():.0%}"])
    publish(
        {"mutants": table(["package", "mutants", "killed", "survived", "not run", "score"], rows)}, write=options.write
    )
    for result in results:
        if result.outcome != "killed":
            where = f"{result.mutant.file}:{result.mutant.line} {result.outcome}"
            console.print(where, f"  - {result.before}", f"  + {result.after}", sep="\n", markup=False, soft_wrap=True)


if __name__ == "__main__":
    main()
