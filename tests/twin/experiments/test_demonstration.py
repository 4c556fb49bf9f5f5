"""The demonstration stops where a command fails. That it runs to its end is seen by everyone who runs it."""

import pytest

from twin.experiments.demonstration import demo
from uwlts.errors import CommandFailed


def test_a_command_that_fails_ends_the_demo_and_says_why(tmp_path, capfd):
    (tmp_path / "plan.json").mkdir()
    with pytest.raises(CommandFailed) as failed:
        demo(tmp_path)
    printed, complaints = capfd.readouterr()
    assert failed.value.returncode == 2
    assert printed.startswith("$ twin record demo --out ")
    assert printed.count("$ ") == 1
    assert complaints.startswith("error: ")
    assert "plan.json" in complaints
    assert [each.name for each in tmp_path.iterdir()] == ["plan.json"]
