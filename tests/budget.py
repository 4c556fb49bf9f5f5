"""Size of the product: lines, lines of code and modules of each package, and the limits in `budget.toml`.

    python -m tests.budget            # print the present size of each package, and its change from the record
    python -m tests.budget --write    # lower the recorded figures to the present size; none is raised

A line of code is neither blank, nor a comment, nor part of a docstring; strings below constants are docstrings, too.
"""

import argparse
import ast
import io
import tokenize
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
RECORD = Path(__file__).with_name("budget.toml")
PRODUCT = ("uwlts", "twin")
HEAD = """# Limits of the product's size: lines, lines of code, modules. A package may grow within the limit of uwlts or
# twin. `python -m tests.budget --write` lowers the figures to the present size, and raises none.
"""
_MOST_SLACK = 0.01
"""Share of a limit by which the product may be smaller before the record has to follow: 700 lines of uwlts."""
_NO_CODE = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}


class Size(NamedTuple):
    """Lines, lines of code, and modules."""

    lines: int
    code: int
    modules: int


def count_code(text: str) -> int:
    """Return the number of lines of code of a module."""
    rows: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in _NO_CODE:
            rows.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            rows.difference_update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return len(rows)


def measure_packages(root: Path = ROOT) -> dict[str, Size]:
    """Return the sizes of the packages at the first level; modules beside them are ``*.py``."""
    found: dict[str, Size] = {}
    for product in PRODUCT:
        for path in sorted((root / product).rglob("*.py")):
            text, parts = path.read_text(encoding="utf-8"), path.relative_to(root).parts
            name = f"{product}/{parts[1] if len(parts) > 2 else '*.py'}"
            size = Size(text.count("\n"), count_code(text), 1)
            found[name] = Size(*map(sum, zip(found.get(name, Size(0, 0, 0)), size, strict=True)))
    return found


def total(packages: Mapping[str, Size], product: str) -> Size:
    """Return the size of a product with all its packages."""
    own = [size for name, size in packages.items() if name.partition("/")[0] == product]
    return Size(*map(sum, zip(*own, strict=True)))


def read_record(path: Path = RECORD) -> tuple[Size, dict[str, Size], dict[str, Size]]:
    """Return the goal of both products together, the limit of each, and the recorded sizes of the packages."""
    table = tomllib.loads(path.read_text(encoding="utf-8"))
    limits, packages = ({name: Size(*size) for name, size in table[key].items()} for key in ("limits", "packages"))
    return Size(*table["goal"]), limits, packages


def find_growth(packages: Mapping[str, Size], recorded: Mapping[str, Size], product: str, figure: str) -> str:
    """Return the packages of a product that grew in a figure since the record, the largest growth first."""
    grown = {
        name: getattr(size, figure) - getattr(recorded.get(name, Size(0, 0, 0)), figure)
        for name, size in packages.items()
        if name.partition("/")[0] == product
    }
    return ", ".join(f"{name} +{more}" for name, more in sorted(grown.items(), key=lambda each: -each[1]) if more > 0)


def find_excess(packages: Mapping[str, Size], limits: Mapping[str, Size], recorded: Mapping[str, Size]) -> list[str]:
    """Return a message for each limit that is exceeded, or from which the product has shrunk far enough to lower it."""
    messages = []
    for product, limit in limits.items():
        for figure, found, most in zip(Size._fields, total(packages, product), limit, strict=True):
            if found > most:
                grown = find_growth(packages, recorded, product, figure)
                messages.append(
                    f"{product} has {found} {figure}, {found - most} more than its limit of {most}; grown since the "
                    f"record: {grown}. Remove as much as you add"
                )
            elif found < (1 - _MOST_SLACK) * most:
                messages.append(
                    f"{product} has {found} {figure}, far below its limit of {most}: lower the limit with "
                    "python -m tests.budget --write"
                )
    return messages


def lower_record(packages: Mapping[str, Size], path: Path = RECORD) -> None:
    """Lower the recorded figures to the present sizes; new packages are added, and removed ones left out."""
    goal, limits, recorded = read_record(path)

    def row(name: str, size: Size, known: Mapping[str, Size]) -> str:
        return f'"{name}" = {[min(pair) for pair in zip(size, known.get(name, size), strict=True)]}\n'

    path.write_text(
        f"{HEAD}\ngoal = {[*goal]}\n\n[limits]\n"
        + "".join(row(product, total(packages, product), limits) for product in PRODUCT)
        + "\n[packages]\n"
        + "".join(row(name, size, recorded) for name, size in sorted(packages.items())),
        encoding="utf-8",
    )


def main() -> None:
    """Print the sizes and their changes, and lower the record if that is wanted."""
    parser = argparse.ArgumentParser(description="Size of the product: lines, lines of code, modules.")
    parser.add_argument("--write", action="store_true", help="lower the recorded figures to the present size")
    wanted = parser.parse_args()
    packages = measure_packages()
    goal, limits, recorded = read_record()
    both = Size(*map(sum, zip(*(total(packages, product) for product in PRODUCT), strict=True)))
    rows = packages | {product: total(packages, product) for product in PRODUCT}
    for name, size in sorted(rows.items()):
        change = "".join(f"{a - b:+8d}" for a, b in zip(size, (recorded | limits).get(name, size), strict=True))
        print(f"{name:24}" + "".join(f"{each:8d}" for each in size) + "   " + change)
    print(f"{'both':24}" + "".join(f"{each:8d}" for each in both) + f"   goal {', '.join(map(str, goal))}")
    if wanted.write:
        lower_record(packages)


if __name__ == "__main__":
    main()
