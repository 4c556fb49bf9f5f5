"""Unpacking of packages into a folder of the user's; `test_llvm.py` tests how packages are obtained."""

import pytest

from twin.backend import packages
from uwlts.errors import SetupError


def unpack(folder, text):
    program = folder / "usr" / "bin" / "program"
    program.parent.mkdir(parents=True)
    program.write_text(text)
    program.chmod(0o755)
    program.with_name("link").symlink_to("program")
    return folder


def test_a_tree_takes_the_place_of_an_earlier_one(tmp_path):
    target = tmp_path / "own"
    for text in ("first", "second"):
        packages.move_tree(unpack(tmp_path / text, text), target)
        assert [path.name for path in target.iterdir()] == [packages.TREE]
        link = target / packages.TREE / "usr" / "bin" / "link"
        assert link.is_symlink() and link.read_text() == text and link.stat().st_mode & 0o111


@pytest.mark.parametrize("place", [packages.move_tree, packages.copy_libraries])
def test_a_folder_that_cannot_be_written_to_is_reported(tmp_path, place):
    (tmp_path / "own").write_text("a file")
    with pytest.raises(SetupError, match="cannot write to .*own"):
        place(unpack(tmp_path / "unpacked", "text"), tmp_path / "own")
