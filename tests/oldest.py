"""Print the oldest allowed version of each dependency as requirements of pip: ``python -m tests.oldest test``.

The arguments name extras of the project. Their dependencies, including those of extras that they name, are added to the
project's own. Pinned versions are left out.
"""

import argparse
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement

PROJECT = Path(__file__).resolve().parents[1] / "pyproject.toml"


def oldest(*extras: str) -> list[str]:
    """Requirements ``name==version`` of the project's dependencies and those of its extras, sorted by name."""
    project = tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]
    lowest = {}
    for one in requirements(project, extras):
        name = f"{one.name}[{','.join(one.extras)}]" if one.extras else one.name
        for part in one.specifier:
            if part.operator == ">=":
                lowest[name] = part.version
    return sorted(f"{name}=={version}" for name, version in lowest.items())


def requirements(project: dict[str, Any], extras: tuple[str, ...]) -> Iterator[Requirement]:
    """Yield requirements of a project table and of its extras, including extras that these name."""
    lists = [project["dependencies"], *(project["optional-dependencies"][extra] for extra in extras)]
    for one in (Requirement(line) for lines in lists for line in lines):
        if one.name == project["name"]:
            yield from requirements(project | {"dependencies": []}, tuple(sorted(one.extras)))
        else:
            yield one


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Print the oldest allowed version of each dependency.")
    parser.add_argument("extras", nargs="*", help="extras whose dependencies count too")
    print("\n".join(oldest(*parser.parse_args().extras)))
