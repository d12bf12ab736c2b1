# SPDX-License-Identifier: Apache-2.0
"""Does a test fail for every small change of the code that decides where wheels turn and bytes go? `make mutants`.

cosmic-ray makes the mutants; each is imported in place of its module by a process of its own, that runs the module's
unit tests. Nothing is written: the checkout stays as it is. A mutant is killed when a test fails or time runs out.
Mutants without an observable effect are listed in mutants.toml, each with its reason. A listed mutant that is killed,
or that is no longer made, fails as one that survives does.

    make mutants ARGS="codec odometry"      only files with these words in their path
"""

import difflib
import gc
import importlib.util
import multiprocessing
import os
import resource
import sys
import tomllib
import warnings
from collections.abc import Iterator, Sequence
from importlib.machinery import ModuleSpec, SourceFileLoader
from pathlib import Path
from time import monotonic
from types import CodeType
from typing import Any, NamedTuple

import shared.repeatable  # before numpy

# isort: split
# what every mutant's process needs is imported once, here; nothing of the code under test
import hypothesis.extra.numpy  # noqa: F401
import numba
import pytest
import pytest_timeout  # noqa: F401
import xdist.plugin  # noqa: F401
from cosmic_ray.ast import Visitor, ast_nodes, get_ast
from cosmic_ray.operators.provider import OperatorProvider
from hypothesis import Phase, settings

import shared.config
import shared.messages  # noqa: F401

numba.config.DISABLE_JIT = True  # a kernel is mutated as the Python that it is

ROOT = Path(__file__).resolve().parent.parent
LISTED = Path(__file__).with_suffix(".toml")
IDENTITY = {"Is", "IsNot"}
BITWISE = {"RShift", "LShift", "BitOr", "BitAnd", "BitXor"}
DOCS = "tests/test_architecture.py::test_generated_docs_are_fresh"  # knows the bounds of every setting
DRIVER, ODOMETRY = "tests/unit/services/base_driver", "tests/unit/services/odometry"
WITHOUT_FUZZING = "not undoes and not random and not damaged"
TESTS: dict[str, Sequence[str]] = {
    "services/base_driver/kinematics.py": [f"{DRIVER}/test_kinematics.py"],
    "services/base_driver/encoders.py": [f"{DRIVER}/test_encoders.py", DOCS],
    "services/base_driver/drrobot.py": [f"{DRIVER}/test_drrobot.py"],
    "services/odometry/dead_reckoning.py": [f"{ODOMETRY}/test_dead_reckoning.py", DOCS],
    "shared/drrobot.py": ["tests/unit/shared/test_drrobot.py"],
    "shared/codec.py": ["tests/unit/test_wire_format.py", "tests/unit/test_codec.py", "-k", WITHOUT_FUZZING],
}
CPU_SECONDS = 20  # the unchanged code's tests need 1 to 3; of the processor's time, since others may use it too
MAX_MEMORY_BYTES = 4 << 30


class Change(NamedTuple):
    """A mutant by what differs: the lines as they were and as they are, without indentation."""

    file: str
    was: str
    now: str


class Mutation(Visitor):
    """Applies an operator where it applies for the n-th time."""

    def __init__(self, operator: Any, n: int) -> None:
        self.operator, self.n = operator, n

    def visit(self, node: Any) -> Any:
        for i, _ in enumerate(self.operator.mutation_positions(node)):
            self.n -= 1
            if self.n == -1:
                return self.operator.mutate(node, i)
        return node


def mutants(file: str, source: str) -> Iterator[tuple[Change, str]]:
    """Every mutant that cosmic-ray's operators make, and its whole source."""
    provider = OperatorProvider()
    for kind in [provider[name] for name in provider if not crosses(name)]:
        if kind.arguments():  # it needs the names of the variables to exchange
            continue
        operator, nodes = kind(), ast_nodes(get_ast(source))
        for n in range(sum(len(list(operator.mutation_positions(node))) for node in nodes)):
            mutated = Mutation(operator, n).walk(get_ast(source)).get_code()
            lines = list(difflib.ndiff(source.splitlines(), mutated.splitlines()))
            was, now = ("\n".join(line[2:].strip() for line in lines if line[0] == sign).strip() for sign in "-+")
            yield Change(file, was, now), mutated


def crosses(name: str) -> bool:
    """Whether an operator puts arithmetic in the place of bits, or order in the place of identity, or the other way.

    Such a mutant fails on the first float or class that it meets, or (`==` for `is`) is the same for all classes.
    """
    _, *kinds = name.split("_")
    return any(len({kind in group for kind in kinds}) > 1 for group in (BITWISE, IDENTITY))


class InPlace(SourceFileLoader):
    """Finds and loads one module from a text instead of its file."""

    def __init__(self, file: str, source: str) -> None:
        super().__init__(file.removesuffix(".py").replace("/", "."), str(ROOT / file))
        self.source = source

    def find_spec(self, name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        return importlib.util.spec_from_file_location(name, self.path, loader=self) if name == self.name else None

    def get_code(self, fullname: str) -> CodeType:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # `is` beside a text is a mutant for the tests, not for the compiler
            return compile(self.source, self.path, "exec")


class FirstFailure:
    """Ends a test at its first failing example, however long it is."""

    def pytest_sessionstart(self) -> None:
        at_once = {"phases": (Phase.explicit, Phase.generate), "report_multiple_bugs": False}
        settings.register_profile("mutants", settings.get_profile("steady"), **at_once)
        settings.load_profile("mutants")


def tested(file: str, source: str) -> None:
    """In a process of its own: the file's tests, with this source in place of the file's; its status is theirs."""
    nothing = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 1)
    os.dup2(nothing, 2)
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_SECONDS, CPU_SECONDS))
    resource.setrlimit(resource.RLIMIT_AS, (MAX_MEMORY_BYTES, MAX_MEMORY_BYTES))
    sys.meta_path.insert(0, InPlace(file, source))  # type: ignore[arg-type]  # it finds, and it loads
    options = ["-x", "-p", "no:cacheprovider", "-p", "no:xdist", "-W", "ignore::pytest.PytestAssertRewriteWarning"]
    os._exit(pytest.main([*options, *TESTS[file]], [FirstFailure()]))


def passes(file: str, source: str) -> bool:
    """Whether the file's tests pass with this source."""
    process = multiprocessing.get_context("fork").Process(target=tested, args=(file, source))
    process.start()
    process.join()
    return process.exitcode == 0


def judged(file: str, listed: dict[Change, str]) -> bool:
    """Whether each of the file's mutants is killed, or listed; prints those that are not."""
    source, begun = (ROOT / file).read_text(encoding="utf-8"), monotonic()
    if not passes(file, source):
        print(f"{file}: its tests fail without any change: {' '.join(TESTS[file])}")
        return False
    alive, killed, n = set(), set(), 0
    for change, mutated in mutants(file, source):
        n += 1
        if not passes(file, mutated):
            killed.add(change)
            continue
        alive.add(change)
        if change not in listed:
            print(f"{file}: survives\n    - {change.was}\n    + {change.now}", flush=True)
    stale = [change for change in listed if change.file == file and (change in killed or change not in alive)]
    for change in stale:
        print(f"{file}: listed, and {'killed' if change in killed else 'no mutant'}\n    + {change.now}")
    print(f"{file}: {n} mutants, {len(alive - set(listed))} survive, {monotonic() - begun:.0f} s", flush=True)
    return alive <= set(listed) and not stale


def main(words: list[str]) -> int:
    rows = tomllib.loads(LISTED.read_text(encoding="utf-8"))["equivalent"]
    listed = {Change(row["file"], row["was"], row["now"]): row["why"] for row in rows}
    files = [file for file in TESTS if not words or any(word in file for word in words)]
    if not files:
        print(f"no file has {' or '.join(words)} in its path: {' '.join(TESTS)}")
        return 1
    gc.freeze()
    verdicts = [judged(file, listed) for file in files]  # all of them, also after one that fails
    return 0 if all(verdicts) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
