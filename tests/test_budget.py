"""The product stays within its limits of size, and whoever makes it larger is named."""

from pathlib import Path

import pytest

from tests.budget import (
    PRODUCT,
    RECORD,
    Size,
    count_code,
    find_excess,
    lower_record,
    measure_packages,
    read_record,
    total,
)

KNOWN = {"uwlts/a": Size(500, 300, 5), "uwlts/b": Size(500, 300, 5), "twin/c": Size(100, 60, 1)}
LIMITS = {"uwlts": Size(1000, 600, 10), "twin": Size(100, 60, 1)}


@pytest.fixture(scope="module")
def packages() -> dict[str, Size]:
    return measure_packages()


def test_the_product_stays_within_its_limits(packages):
    _, limits, recorded = read_record()
    assert limits.keys() == set(PRODUCT)
    assert find_excess(packages, limits, recorded) == []


def test_blank_lines_comments_and_docstrings_are_no_code():
    text = '"""Module\nof two lines."""\n\nimport os  # used\n\nA = 1\n"""Reason."""\n\n\ndef f():\n    """Say."""\n'
    text += '    # why\n    return """of\n\nthree lines"""\n'
    # import, A, def, and the string of three lines, in which the empty one counts.
    assert count_code(text) == 6


def test_every_module_is_counted_once(packages):
    root = RECORD.parents[1]
    for product in PRODUCT:
        paths = list((root / product).rglob("*.py"))
        size = total(packages, product)
        assert size.modules == len(paths) > 50
        assert size.lines == sum(len(path.read_bytes().splitlines()) for path in paths)
        assert 0.5 * size.lines < size.code < size.lines


def test_packages_may_grow_within_the_limit():
    assert find_excess(KNOWN | {"uwlts/a": Size(600, 380, 6), "uwlts/b": Size(400, 220, 4)}, LIMITS, KNOWN) == []


def test_who_grew_is_named():
    grown = KNOWN | {"uwlts/a": Size(530, 300, 5), "uwlts/b": Size(490, 300, 5), "uwlts/new": Size(20, 0, 0)}
    (message,) = find_excess(grown, LIMITS, KNOWN)
    assert message.startswith("uwlts has 1040 lines, 40 more than its limit of 1000; ")
    assert "uwlts/a +30, uwlts/new +20." in message


def test_a_limit_far_above_is_to_be_lowered():
    messages = find_excess(KNOWN | {"uwlts/a": Size(480, 300, 5)}, LIMITS, KNOWN)
    assert [message.partition(",")[0] for message in messages] == ["uwlts has 980 lines"]
    assert "--write" in messages[0]


@pytest.mark.parametrize("lines", [400, 600])
def test_the_record_is_lowered_and_never_raised(tmp_path: Path, lines: int):
    record = tmp_path / "budget.toml"
    rows = "".join(f'"{name}" = {[*size]}\n' for name, size in KNOWN.items())
    limits = "".join(f"{name} = {[*size]}\n" for name, size in LIMITS.items())
    record.write_text(f"goal = [1, 1, 1]\n[limits]\n{limits}[packages]\n{rows}")
    lower_record(KNOWN | {"uwlts/a": Size(lines, 300, 5), "uwlts/d": Size(0, 0, 0)}, record)
    _, lowered, kept = read_record(record)
    assert lowered["uwlts"] == Size(min(1000, lines + 500), 600, 10) and lowered["twin"] == LIMITS["twin"]
    assert kept["uwlts/a"] == Size(min(500, lines), 300, 5)
    assert kept.keys() == {*KNOWN, "uwlts/d"}
