# SPDX-License-Identifier: Apache-2.0
"""The rules of writing (docs/writing.md) as a test: words, length of sentences, names of bounds, names of classes.

A folder that does not keep them yet has its number of violations in ALLOWED. The number may only fall.
"""

import ast
import io
import re
import tokenize
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent

BANNED = {
    r"anew": "again",
    r"mend(?:s|ed|ing)?": "hint, fix, repair",
    r"nobody": "no client, no service, nothing",
    r"tells?": "gives, shows, contains",
    r"told": "given, informative",
    r"by now": "now",
    r"who(?:m|ever)?": "name the robot, the user, the service",
    r"heeds?": "follows, obeys",
    r"keener": "stronger",
    r"hangs? together": "is connected",
    r"answers? for": "is responsible for",
    r"made to walk": "moved",
    r"young|younger|youngest": "newer, recent",
    r"lies? astray|astray": "displaced, lost",
    r"reckoned": "predicted, dead-reckoned",
}
"""Word or phrase that the project does not write, and what it writes instead."""

CORRECT = (
    r"who(?:ever)? drives",  # arbitration of teleoperation: the term of the page and of its users
    r"mend: ",  # the prefix of a rule's second line, until it is `hint:`
)
"""Uses of these words that are right."""

MAX_WORDS = 25
BOUNDS = {"MOST", "LEAST", "LONGEST", "FARTHEST", "SHORTEST", "LARGEST", "SMALLEST", "HIGHEST", "LOWEST", "FEWEST"}

ALLOWED: dict[str, tuple[int, int, int]] = {
    "docs": (102, 0, 0),
    "services/mapper": (65, 29, 16),
    "shared": (81, 18, 7),
    "tests": (99, 6, 4),
}
"""Folder: banned words, sentences that are too long, constants without MAX_ or MIN_."""

SAME_NAME: dict[str, int] = {
    "Arrival": 3,
    "Clock": 2,
    "Commander": 2,
    "Gap": 2,
    "Held": 2,
    "Kind": 3,
    "Log": 3,
    "Place": 4,
    "RefusedError": 2,
    "Rig": 2,
    "Row": 4,
    "Run": 3,
    "Seen": 2,
    "Trial": 3,
    "Watch": 2,
    "Wheels": 2,
}
"""Class name: how many classes of the repository have it."""


@dataclass(frozen=True)
class Violation:
    """A place that breaks a rule, and what it should say."""

    place: str
    what: str

    def __str__(self) -> str:
        return f"{self.place}: {self.what}"


def folder_of(path: Path) -> str:
    """services/NAME, zenav/NAME (its files: zenav), shared, tests, docs: what has a number of its own."""
    parts = path.relative_to(ROOT).parts
    if parts[0] in ("services", "zenav") and len(parts) > 2:
        return "/".join(parts[:2])
    return "docs" if path.suffix == ".md" else parts[0]


def files() -> list[Path]:
    code = [p for package in ("shared", "services", "zenav", "tests") for p in (ROOT / package).rglob("*.py")]
    return sorted([*code, ROOT / "README.md", *(ROOT / "docs").rglob("*.md")])


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def docstrings(path: Path) -> Iterator[tuple[int, str]]:
    """(line, text) of each docstring, also of those below a constant or a field."""
    for node in ast.walk(tree(path)):
        for child in getattr(node, "body", []) if not isinstance(node, ast.Lambda | ast.IfExp) else []:
            text = child.value.value if isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant) else None
            if isinstance(text, str):
                yield child.lineno, text


def texts(path: Path) -> Iterator[tuple[int, str]]:
    """(line, text) that a person reads: docstrings, strings of three words and more, comments; lines of a page."""
    if path.suffix == ".md":
        yield from enumerate(prose_of_page(path).splitlines(), 1)
        return
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and len(node.value.split()) >= 3:
            yield node.lineno, node.value
    for token in tokenize.generate_tokens(io.StringIO(path.read_text(encoding="utf-8")).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string


def prose_of_page(path: Path) -> str:
    """A Markdown page, its code blanked out line for line."""
    text = re.sub(r"```.*?```", lambda m: "\n" * m[0].count("\n"), path.read_text(encoding="utf-8"), flags=re.DOTALL)
    text = re.sub(r"`[^`\n]*`|\]\([^)]*\)", " ", text)
    return "\n".join("" if line.startswith("    ") else line for line in text.splitlines())


def sentences(text: str) -> Iterator[str]:
    """The sentences of a docstring: paragraphs and list items end one, too."""
    for paragraph in re.split(r"\n\s*\n|\n\s*(?=[-*\d]+[.)]?\s)", text):
        if not re.search(r"\|.*\|", paragraph):  # a table
            yield from re.split(
                r"(?<=[.!?:;])\s+(?=[A-Z0-9(`\[])|(?<=\.)\s+(?=[a-z_, ]{1,40}: )", " ".join(paragraph.split()) + " "
            )


def banned_words(path: Path) -> Iterator[Violation]:
    word = re.compile(rf"\b(?:{'|'.join(BANNED)})\b", re.IGNORECASE)
    correct = re.compile("|".join(CORRECT), re.IGNORECASE)
    for line, text in texts(path):
        for match in word.finditer(correct.sub(" ", text)):
            better = next(b for pattern, b in BANNED.items() if re.fullmatch(pattern, match[0], re.IGNORECASE))
            yield Violation(f"{path.relative_to(ROOT)}:{line}", f"'{match[0]}': write {better}")


def long_sentences(path: Path) -> Iterator[Violation]:
    if path.suffix == ".py":
        for line, text in docstrings(path):
            for sentence in sentences(text):
                if (n := len(re.findall(r"[\w'-]*[A-Za-z][\w'.-]*", sentence))) > MAX_WORDS:
                    where = f"{path.relative_to(ROOT)}:{line}"
                    yield Violation(where, f"{n} words in one sentence: {sentence[:60]}...")


def unnamed_bounds(path: Path) -> Iterator[Violation]:
    if path.suffix == ".py":
        for node in tree(path).body:
            for target in node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]:
                for name in ast.walk(target) if target is not None else ():
                    if isinstance(name, ast.Name) and name.id.isupper() and BOUNDS & set(name.id.split("_")):
                        yield Violation(
                            f"{path.relative_to(ROOT)}:{node.lineno}", f"{name.id}: begin with MAX_ or MIN_"
                        )


RULES = (banned_words, long_sentences, unnamed_bounds)
FOLDERS = sorted({folder_of(path) for path in files()})


def violations(folder: str) -> list[list[Violation]]:
    """Of a folder, for each rule."""
    return [
        [v for p in files() if folder_of(p) == folder and p.name != "test_language.py" for v in r(p)] for r in RULES
    ]


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_folder_keeps_the_rules_of_writing(folder):
    allowed = ALLOWED.get(folder, (0, 0, 0))
    for rule, found, n in zip(RULES, violations(folder), allowed, strict=True):
        if len(found) > n:
            listed = "\n".join(map(str, found[: n + 20]))
            pytest.fail(f"{folder}: {len(found)} {rule.__name__}, {n} allowed (docs/writing.md):\n{listed}", False)
        if len(found) < n:
            pytest.fail(
                f"{folder}: {len(found)} {rule.__name__}, {n} allowed\nhint: lower ALLOWED to {len(found)}", False
            )


def test_a_class_name_has_one_meaning():
    places = defaultdict(list)
    for path in files():
        if path.suffix == ".py" and folder_of(path) != "tests":
            for node in ast.walk(tree(path)):
                if isinstance(node, ast.ClassDef):
                    places[node.name].append(f"{path.relative_to(ROOT)}:{node.lineno}")
    twice = {name: at for name, at in places.items() if len(at) > SAME_NAME.get(name, 1)}
    assert not twice, "\n".join(f"{name}: {', '.join(at)}" for name, at in sorted(twice.items()))
    better = {name: len(places[name]) for name, n in SAME_NAME.items() if len(places[name]) < n}
    assert not better, f"hint: lower SAME_NAME to {better}"


def test_a_banned_word_a_long_sentence_and_a_bound_are_found(tmp_path, monkeypatch):
    monkeypatch.setattr("tests.test_language.ROOT", tmp_path)
    path = tmp_path / "zenav" / "some.py"
    path.parent.mkdir()
    words = " ".join(["word"] * (MAX_WORDS + 1))
    path.write_text(f'"""Nobody says so.\n\n{words}.\n"""\n\nMOST_ROWS = 3  # who knows\nMAX_ROWS = 4\n')
    assert [len(list(rule(path))) for rule in RULES] == [2, 1, 1]


if __name__ == "__main__":  # prints what is left of a folder, or the table
    import sys

    for folder in sys.argv[1:] or FOLDERS:
        found = violations(folder)
        print(f'    "{folder}": ({", ".join(str(len(f)) for f in found)}),')
        if sys.argv[1:]:
            print(*(v for f in found for v in f), sep="\n")
