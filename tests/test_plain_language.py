"""The check of the project's language finds idioms in texts of every kind, and nothing in code."""

import pytest

from tests import plain_language

FOUND = {
    "module.py": ('x = 1\n"""Limit, of which a half is used."""\n', 2),
    "comment.py": ("x = 1  # it is hardly used\n", 1),
    "message.py": ('raise ValueError("there is nothing to do. What the images show is a plane.")\n', 1),
    "page.md": ("# Title\n\nThis method\nerrs by 1 mm.\n", 3),
}
NOT_FOUND = {
    "module.py": '"""Return ``aside``, and `tells` (N,)."""\naside = write(tells, "aside")\n',
    "page.md": "What is it?\n\n```python\naside = 1\n```\n\n`hardly`\n",
}


@pytest.mark.parametrize("name", FOUND)
def test_idioms_are_found_with_their_line(tmp_path, monkeypatch, name):
    text, line = FOUND[name]
    monkeypatch.setattr(plain_language, "ROOT", tmp_path)
    (tmp_path / name).write_text(text, encoding="utf-8")
    assert [each.split(":")[:2] for each in plain_language.findings(tmp_path / name)] == [[name, str(line)]]


@pytest.mark.parametrize("name", NOT_FOUND)
def test_code_and_questions_are_not_found(tmp_path, monkeypatch, name):
    monkeypatch.setattr(plain_language, "ROOT", tmp_path)
    (tmp_path / name).write_text(NOT_FOUND[name], encoding="utf-8")
    assert list(plain_language.findings(tmp_path / name)) == []


def test_long_sentences_of_docstrings_are_found(tmp_path, monkeypatch):
    monkeypatch.setattr(plain_language, "ROOT", tmp_path)
    (tmp_path / "twin").mkdir()
    path = tmp_path / "twin" / "module.py"
    path.write_text(
        f'"""{"word " * plain_language.MOST_WORDS}(and brackets with any number of words)."""\n', encoding="utf-8"
    )
    assert len(list(plain_language.findings(path))) == 1
    path.write_text(
        f'"""{"word " * (plain_language.MOST_WORDS - 1)}(and brackets with any number of words)."""\n', encoding="utf-8"
    )
    assert not list(plain_language.findings(path))
