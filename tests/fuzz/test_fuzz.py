"""Robust readers: wrong files are rejected by the project's errors, in limited time and memory."""

import json
from pathlib import Path

import pytest
from hypothesis import given, settings, strategies as st

from tests.fuzz.past_failures import PAST
from tests.fuzz.readers import READERS
from tests.fuzz.running import MOST_MIB, MOST_S, Outcome, watched
from uwlts.errors import CaptureError, OutputError
from uwlts.files.reading import parse_json, parse_toml, read_bytes
from uwlts.files.writing import write_atomically
from uwlts.storage.calibration_file import load_calibration

CORPUS = Path(__file__).with_name("corpus")
CASES = 100


@pytest.fixture(scope="module")
def outcomes(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Outcome]]:
    """Return outcomes of the corpus and of past failures, each by its words, and those of changed files by reader.

    One process reads them all, changed files only of the chosen tests of this module.
    """
    folder = tmp_path_factory.mktemp("read")
    work = [(str(path), path.name.split("--")[0], str(path)) for path in sorted(CORPUS.glob("*--*"))]
    for number, (words, (reader, build)) in enumerate(PAST.items()):
        (folder / reader).mkdir(exist_ok=True)
        path = folder / reader / f"past-{number}{READERS[reader].suffix}"
        build(path)
        work.append((words, reader, str(path)))
    items = [item for item in request.session.items if isinstance(item, pytest.Function) and item.path == request.path]
    params = [item.callspec.params for item in items if hasattr(item, "callspec")]
    chosen = [values["reader"] for values in params if "reader" in values]
    work += [(reader, reader, str(number)) for reader in chosen for number in range(CASES)]
    found: dict[str, list[Outcome]] = {}
    for (words, *_), outcome in zip(work, watched(folder, [case for _, *case in work]), strict=True):
        found.setdefault(words, []).append(outcome)
    return found


def test_past_failures_are_refused(outcomes: dict[str, list[Outcome]]):
    past = {words: outcomes[words][0] for words in PAST}
    assert {words: each.fault for words, each in past.items() if each.fault} == {}
    # An altered certificate is reported, not rejected.
    assert [words for words, each in past.items() if not each.refusal] == []
    assert max(each.seconds for each in past.values()) < MOST_S
    assert max(each.mib for each in past.values()) < MOST_MIB
    assert "is an HDF5 file, such as a capture" in past["capture as a calibration"].refusal


def test_corpus(outcomes: dict[str, list[Outcome]]):
    found = [each for words in outcomes.keys() - PAST.keys() - READERS.keys() for each in outcomes[words]]
    assert found and [each for each in found if each.fault] == []


@pytest.mark.slow
@pytest.mark.parametrize("reader", READERS)
def test_changed_files_are_read_or_refused(outcomes: dict[str, list[Outcome]], reader: str):
    found = outcomes[reader]
    assert [each for each in found if each.fault] == []
    # The mutations have an effect: not all files are still read.
    assert len(found) == CASES and sum(bool(each.refusal) for each in found) > 0.1 * CASES


@settings(max_examples=300, deadline=None)
@given(st.text(max_size=200) | st.text(alphabet='[]{}",:.=\n0a \\-eE+x', max_size=200))
def test_any_text_is_parsed_or_refused(text: str):
    for parse in (parse_json, parse_toml):
        try:
            parse(text)
        except ValueError:
            continue


PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False, allow_infinity=False),
    lambda inside: st.lists(inside) | st.dictionaries(st.text(), inside),
    max_leaves=20,
)


@settings(max_examples=200, deadline=None)
@given(PLAIN)
def test_plain_json_comes_back(content):
    assert parse_json(json.dumps(content)) == content


@pytest.mark.parametrize("name", ["x" * 5000, "a\0b", "x" * 300 + ".json"])
def test_names_that_no_file_can_have(tmp_path: Path, name: str):
    for attempt in (lambda: read_bytes(tmp_path / name, most_bytes=10), lambda: load_calibration(tmp_path / name)):
        with pytest.raises(CaptureError):
            attempt()
    with pytest.raises(OutputError), write_atomically(tmp_path / name):
        pytest.fail("the body must not run")


def test_files_that_are_too_large_are_not_read(tmp_path: Path):
    (tmp_path / "a").write_bytes(bytes(11))
    with pytest.raises(CaptureError, match="this program reads up to"):
        read_bytes(tmp_path / "a", most_bytes=10)
