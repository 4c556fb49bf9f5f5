"""Find idioms that this project does not use in its code, docstrings, comments, messages and pages.

Prints each place with what to write instead; exit status 1 if there are any. A finding asks for another sentence, not
for another word at the same place.
"""

import argparse
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("uwlts", "twin", "tests", "docs", "scenes")
PAGES = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")
BUILT = ROOT / "docs" / "_build"
ENDINGS = (".py", ".md", ".j2", ".toml")

INSTEAD = {
    r"of (which|whom|whose)\b": "two sentences, or a compound",
    r"as of (a|an|the)\b": "like, for example",
    r"(tells?|told)\b": "shows, states, determines",
    r"so (many|much)\b(?! that)": "the number itself",
    r"(has|have) not(?=[.,;:)]| any\b)": "does not have",
    r"in words\b(?! of)": "as text",
    r"shares? of (a|an|all)\b": "fraction of",
    r"by way of\b": "by, through",
    r"(goes|went) on\b": "continues",
    r"(alike|beforehand|aside)\b(?! from)": "the same, before, separate",
    r"(hardly|doubtful)\b": "not significantly, uncertain",
    r"errs?\b": "has an error",
    r"(lain|lays)\b": "is",
    r"(anew|nought|lest|thereof|thereby|whereof)\b": "again, 0, so that ... not",
    r"unless given\b": "by default",
    r"the latter\b": "the noun",
}
"""Idiom: what to write instead."""
BEGINNINGS = {
    r"(What|Whether|That which|By how much|How far|How many) [a-z]": "a noun as subject",
    r"Where [a-z]": "If, When; or a place",
    r"(Those|That|Its|Their) (of|that|which)\b": "the noun",
}
"""Beginning of a sentence that is no question: what to write instead."""
ALLOWED = {"docs/studies/vehicle_pass.py": "doubtful"}
"""File: idiom that may stay."""
MOST_WORDS = 28
"""Longest sentence in a docstring. Code, and text in brackets, counts as one word."""

_PATTERNS = [
    *((re.compile(rf"\b{idiom}"), instead) for idiom, instead in INSTEAD.items()),
    *((re.compile(rf"(?:^|[.;:] ){begin}[^.?]*\."), instead) for begin, instead in BEGINNINGS.items()),
]
_TEXTS = re.compile(r'(?P<doc>(?m:^) *r?"""(?:.|\n)*?""")|"""((?:.|\n)*?)"""|"((?:[^"\\\n]|\\.)*)"|#(.*)')
_CODE_IN_TEXT = re.compile(r"``[^`]*``|`[^`]*`|\{[^{}]*\}")
_CODE = re.compile(r"(?s)^---\n.*?\n---\n|```.*?```|`[^`]*`|\{[%{#].*?[%}#]\}|<[^>]*>")


def texts(path: Path) -> Iterator[tuple[int, str, bool]]:
    """Yield the line number of each text of a file, the text, and whether it is a docstring."""
    content = path.read_text(encoding="utf-8")
    if path.suffix != ".py":
        plain = _CODE.sub(lambda code: "x" + "\n" * code[0].count("\n"), content)
        for paragraph in re.finditer(r"\S(?:.|\n)*?(?=\n\s*\n|\Z)", plain):
            yield plain.count("\n", 0, paragraph.start()) + 1, paragraph[0], False
        return
    for found in _TEXTS.finditer(content):
        yield content.count("\n", 0, found.start()) + 1, found[0].strip(' "#'), found["doc"] is not None


def sentences(text: str) -> Iterator[str]:
    """Yield the sentences of a text, with code and brackets as one word each."""
    text = re.sub(r"\([^()]*\)", "x", _CODE_IN_TEXT.sub("x", text))
    yield from re.split(r"(?<=[.:;?!])\s+|\n\s*\n|\n\s*[-*] |\n *-{3,}\n", text)


def findings(path: Path) -> Iterator[str]:
    """Yield each idiom of a file as a line of text."""
    name = str(path.relative_to(ROOT))
    for line, text, is_docstring in texts(path):
        plain = " ".join(_CODE_IN_TEXT.sub("x", text).split())
        # Shorter strings are names.
        for pattern, instead in _PATTERNS if plain.count(" ") > 1 else ():
            for found in pattern.finditer(plain):
                if found[0] != ALLOWED.get(name):
                    yield f"{name}:{line}: '{found[0].strip()[:60]}': write {instead}"
        if is_docstring and name.startswith(("uwlts/", "twin/")):
            for sentence in sentences(text):
                if (words := len(sentence.split())) > MOST_WORDS:
                    yield f"{name}:{line}: a sentence of {words} words; at most {MOST_WORDS}: '{sentence.strip()[:60]}'"


def main() -> int:
    """Print the findings of all files; return the exit status."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    files = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*")) if path.suffix in ENDINGS]
    own = [path for path in files if BUILT not in path.parents and not path.stem.endswith("plain_language")]
    found = [line for path in [*(ROOT / page for page in PAGES), *own] for line in findings(path)]
    for line in found:
        print(line)
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main())
