# SPDX-License-Identifier: Apache-2.0
"""Does a test notice every small change of the kinematics and of the board's codec? `make mutants`, some minutes.

One operator, comparison or number at a time is exchanged, and the module's own tests run on what comes of it, each in a
forked child and without numba, which would compile every mutant anew. A mutant that they let pass is a line that nobody
tests; ALIKE has those that do what the original does.
"""

import os

os.environ["NUMBA_DISABLE_JIT"] = "1"  # noqa: TID251  # read when numba is imported

import shared.repeatable  # noqa: F401  # before numpy

# isort: split
import ast
import copy
import importlib.abc
import importlib.machinery
import importlib.util
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from types import CodeType, ModuleType

import numba  # noqa: F401  # imported once, for all children
import pydantic  # noqa: F401
import pytest
from hypothesis import Phase, settings

ROOT = Path(__file__).resolve().parents[1]
TESTS = {
    "services.base_driver.kinematics": ("tests/unit/services/base_driver/test_kinematics.py",),
    "services.base_driver.drrobot": ("tests/unit/services/base_driver/test_drrobot.py",),
    "shared.drrobot": ("tests/unit/shared/test_drrobot.py",),
}
"""Module, and what must notice."""
ALIKE = {
    "services.base_driver.drrobot: centimetres > 80 -> centimetres >= 80 in: if centimetres > 80:": "none reads 80 cm",
    "services.base_driver.drrobot: centimetres < 10 -> centimetres <= 10 in: "
    "return 0.09 if centimetres < 10 else centimetres / 100": "none reads 10 cm",
    "services.base_driver.drrobot: volts_above > 0 -> volts_above >= 0 in: "
    "centimetres = 21.6 / volts_above if volts_above > 0 else 1000000000.0": "none reads exactly 0.17 V",
    "services.base_driver.drrobot: 1000000000.0 -> 1000000001.0 in: "
    "centimetres = 21.6 / volts_above if volts_above > 0 else 1000000000.0": "either is far",
    "shared.drrobot: 256 -> 257 in: table = np.arange(256, dtype=np.uint8)": "no byte looks the last one up",
    "shared.drrobot: 5 -> 6 in: if i + 5 >= n:": "a packet is longer than that",
    "shared.drrobot: 0 -> 1 in: return (WRONG, 0)": "nobody looks at its length",
    "shared.drrobot: 0 -> 1 in: return (INCOMPLETE, 0)": "nobody looks at its length",
    "shared.drrobot: 1 -> 2 in: waiting = -1": "less than 0 is nothing",
    "shared.drrobot: 1 -> 2 in: lost, waiting = (False, -1)": "less than 0 is nothing",
    "shared.drrobot: len(data) // OVERHEAD -> len(data) * OVERHEAD in: "
    "starts = np.empty(len(data) // OVERHEAD, np.int64)": "more room than is needed",
}
"""Mutant, and why it does what the original does."""
PATIENCE = 120  # s until a mutant that does not end counts as noticed

OPERATORS: dict[type[ast.AST], type[ast.AST]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult,
    ast.LShift: ast.RShift, ast.RShift: ast.LShift, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd, ast.BitXor: ast.BitOr,
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In, ast.And: ast.Or, ast.Or: ast.And,
}  # fmt: skip


def changed(node: ast.AST) -> bool:
    """Changes a node in place; False where there is nothing to change."""
    match node:
        case ast.BinOp() | ast.AugAssign() | ast.BoolOp() if type(node.op) in OPERATORS:
            node.op = OPERATORS[type(node.op)]()
        case ast.Compare() if type(node.ops[0]) in OPERATORS:
            node.ops[0] = OPERATORS[type(node.ops[0])]()
        case ast.UnaryOp():
            node.op = ast.UAdd() if isinstance(node.op, ast.USub) else ast.USub()
        case ast.Constant(bool() as value):
            node.value = not value
        case ast.Constant(int() | float() as value):
            node.value = value + 1
        case _:
            return False
    return True


def untouched(tree: ast.Module) -> set[int]:
    """ids of nodes that say nothing about what is done: annotations and decorators."""
    roots: list[ast.AST | None] = []
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef() | ast.ClassDef():
                roots += node.decorator_list
                roots += [node.returns] if isinstance(node, ast.FunctionDef) else []
            case ast.arg() | ast.AnnAssign():
                roots.append(node.annotation)
    return {id(node) for root in roots if root is not None for node in ast.walk(root)}


def mutants(name: str, source: str) -> Iterator[tuple[str, CodeType]]:
    """What each is called, and its code."""
    tree = ast.parse(source)
    left_alone = untouched(tree)
    nodes = list(ast.walk(tree))
    statement = {id(part): node for node in nodes if isinstance(node, ast.stmt) for part in ast.walk(node)}
    for i, node in enumerate(nodes):
        if id(node) in left_alone or not hasattr(node, "lineno"):
            continue
        other = copy.deepcopy(tree)
        mutated = list(ast.walk(other))[i]
        if not changed(mutated):
            continue
        there = statement[id(node)]
        line = ast.unparse(there).splitlines()[0] if not isinstance(there, ast.FunctionDef) else there.name
        title = f"{name}: {ast.unparse(node)} -> {ast.unparse(mutated)} in: {line}"
        yield title, compile(ast.fix_missing_locations(other), name, "exec")


class Mutant(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Stands in for a module."""

    def __init__(self, name: str, code: CodeType) -> None:
        self.name, self.code = name, code

    def find_spec(self, fullname: str, path: object, target: object = None) -> importlib.machinery.ModuleSpec | None:
        return importlib.util.spec_from_loader(fullname, self) if fullname == self.name else None

    def exec_module(self, module: ModuleType) -> None:
        exec(self.code, module.__dict__)


def survives(mutant: Mutant, tests: tuple[str, ...]) -> bool:
    """Whether the tests pass with it in the module's place."""
    child = os.fork()
    if not child:
        signal.alarm(PATIENCE)
        silent = os.open(os.devnull, os.O_WRONLY)
        os.dup2(silent, 1)
        os.dup2(silent, 2)
        sys.meta_path.insert(0, mutant)
        plain = ("-x", "-q", "--assert=plain", "-p", "no:cacheprovider", "--hypothesis-profile", "mutants")
        os._exit(int(pytest.main([*plain, *tests])))
    _, status = os.waitpid(child, 0)
    return status == 0


def main(names: list[str]) -> int:
    """0 when no mutant lives that is not ALIKE. names: of modules; none: all."""
    os.chdir(ROOT)
    phases = (Phase.explicit, Phase.generate)  # what fails need not be made small
    settings.register_profile("mutants", deadline=None, derandomize=True, database=None, phases=phases)
    n = n_alive = 0
    for name in names or TESTS:
        source = (ROOT / f"{name.replace('.', '/')}.py").read_text()
        if not survives(Mutant(name, compile(source, name, "exec")), TESTS[name]):
            print(f"{name}: its tests fail as it is")
            return 1
        for title, code in mutants(name, source):
            n += 1
            if title not in ALIKE and survives(Mutant(name, code), TESTS[name]):
                n_alive += 1
                print(f"lives: {title}", flush=True)
    print(f"{n} mutants, {n_alive} live")
    return 1 if n_alive else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
