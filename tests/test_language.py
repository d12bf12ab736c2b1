# SPDX-License-Identifier: Apache-2.0
"""The rules of writing (docs/writing.md) as a test: words, sentences, names of bounds and classes, sources.

`python -m tests.test_language FOLDER ...` lists the violations of folders.
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

CORRECT = (r"`mended`",)  # a field of a request
"""Uses of these words that are right."""

GENERATED = {"messages.md", "configuration.md", "api.md"}
"""Pages of `zenav.docs`: their text is counted where it is written, in the code."""

ALGORITHM_SERVICES = ("mapper", "planner", "local_ctrl", "guard", "odometry")
"""Services whose algorithm files name the source of their method."""

NO_ALGORITHM = {
    *("__init__", "__main__", "service", "config", "warm_up"),
    *("debug_topics", "inputs", "received_plan", "reconfiguration"),  # of local_ctrl
    *("map_jobs", "map_file", "map_transfer", "map_editing", "resume", "graph_topic"),  # of mapper
    "plan_message",  # of planner
}
"""Their files that hold no algorithm: processes, handlers, settings, order of jobs, bytes, ages."""

SOURCE = re.compile(r"\b(?:(?:19|20)\d\d|Nav2|Cartographer|Karto|AMCL|PCL|ROS|(?:REP|ISO) \d+|[Oo]ur own)\b")
"""The source of an algorithm: a year of publication, a program, a standard, or the words that it is our own."""

MAX_WORDS = 25
BOUNDS = {"MOST", "LEAST", "LONGEST", "FARTHEST", "SHORTEST", "LARGEST", "SMALLEST", "HIGHEST", "LOWEST", "FEWEST"}


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


@cache
def files() -> list[Path]:
    code = [p for package in ("shared", "services", "zenav", "tests") for p in (ROOT / package).rglob("*.py")]
    pages = [page for page in (ROOT / "docs").rglob("*.md") if page.name not in GENERATED]
    return sorted([*code, ROOT / "README.md", *pages])


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def nodes(path: Path) -> tuple[ast.AST, ...]:
    """All that a file consists of."""
    return tuple(ast.walk(tree(path)))


def docstrings(path: Path) -> Iterator[tuple[int, str]]:
    """(line, text) of each docstring, also of those below a constant or a field."""
    for node in nodes(path):
        for child in getattr(node, "body", []) if not isinstance(node, ast.Lambda | ast.IfExp) else []:
            text = child.value.value if isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant) else None
            if isinstance(text, str):
                yield child.lineno, text


def texts(path: Path) -> Iterator[tuple[int, str]]:
    """(line, text) that a person reads: docstrings, strings of three words and more, comments; lines of a page."""
    if path.suffix == ".md":
        yield from enumerate(prose_of_page(path).splitlines(), 1)
        return
    for node in nodes(path):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and len(node.value.split()) >= 3:
            yield node.lineno, node.value
    for token in tokenize.generate_tokens(io.StringIO(path.read_text(encoding="utf-8")).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string


def prose_of_page(path: Path) -> str:
    """A Markdown page, line for line, without code and the tables of figures, which programs write."""

    def blank(match: re.Match[str]) -> str:
        return "\n" * match[0].count("\n")

    text = path.read_text(encoding="utf-8")
    text = re.sub(r"```.*?```|<!-- figures: .*?<!-- end -->", blank, text, flags=re.DOTALL)
    text = re.sub(r"`[^`\n]*`", "X", re.sub(r"\]\([^)]*\)", "]", text)).replace("**", "")
    lines: list[str] = []
    is_code, is_blank = False, True
    for line in text.splitlines():  # code begins after an empty line; elsewhere the line belongs to a list item
        is_code = line.startswith("    ") and (is_blank or is_code)
        is_blank = not line.strip()
        lines.append("" if is_code else line)
    return "\n".join(lines)


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
    for line, text in [(1, prose_of_page(path))] if path.suffix == ".md" else docstrings(path):
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


def names_source(path: Path) -> bool:
    """Whether a docstring of the file names where its algorithm comes from."""
    return any(SOURCE.search(text) for _, text in docstrings(path))


RULES = (banned_words, long_sentences, unnamed_bounds)
FOLDERS = sorted({folder_of(path) for path in files()})


def violations(folder: str) -> list[list[Violation]]:
    """Of a folder, for each rule."""
    return [
        [v for p in files() if folder_of(p) == folder and p.name != "test_language.py" for v in r(p)] for r in RULES
    ]


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_folder_keeps_the_rules_of_writing(folder):
    for rule, found in zip(RULES, violations(folder), strict=True):
        if found:
            listed = "\n".join(map(str, found[:20]))
            pytest.fail(f"{folder}: {len(found)} {rule.__name__} (docs/writing.md):\n{listed}", False)


def test_an_algorithm_file_names_its_source_or_says_that_it_is_our_own():
    paths = [path for name in ALGORITHM_SERVICES for path in sorted((ROOT / "services" / name).rglob("*.py"))]
    algorithms = [path for path in paths if path.stem not in NO_ALGORITHM]
    unsourced = [str(path.relative_to(ROOT)) for path in algorithms if not names_source(path)]
    assert not unsourced, f"add the paper, book or program, or 'our own' (docs/writing.md): {unsourced}"
    assert {path.stem for path in paths} >= NO_ALGORITHM  # no name of a file that is gone


def test_a_missing_source_is_found(tmp_path):
    path = tmp_path / "none.py"
    path.write_text('"""Sorts 300 poses by their own order."""\n\nBOOK = "Smith 1957"  # Nav2\n')
    assert not names_source(path)
    for i, source in enumerate(("As Smith 1957.", "After Nav2's Spin.", "The rule is our own.")):
        path = tmp_path / f"{i}.py"
        path.write_text(f'"""Sorts poses. {source}"""\n')
        assert names_source(path), source


def test_a_class_name_has_one_meaning():
    places = defaultdict(list)
    for path in files():
        if path.suffix == ".py" and folder_of(path) != "tests":
            for node in nodes(path):
                if isinstance(node, ast.ClassDef):
                    places[node.name].append(f"{path.relative_to(ROOT)}:{node.lineno}")
    twice = {name: at for name, at in places.items() if len(at) > 1}
    assert not twice, "\n".join(f"{name}: {', '.join(at)}" for name, at in sorted(twice.items()))


def test_a_banned_word_a_long_sentence_and_a_bound_are_found(tmp_path, monkeypatch):
    monkeypatch.setattr("tests.test_language.ROOT", tmp_path)
    path = tmp_path / "zenav" / "some.py"
    path.parent.mkdir()
    words = " ".join(["word"] * (MAX_WORDS + 1))
    path.write_text(f'"""Nobody says so.\n\n{words}.\n"""\n\nMOST_ROWS = 3  # who knows\nMAX_ROWS = 4\n')
    assert [len(list(rule(path))) for rule in RULES] == [2, 1, 1]


if __name__ == "__main__":
    import sys

    for folder in sys.argv[1:] or FOLDERS:
        print(*(violation for found in violations(folder) for violation in found), sep="\n")
