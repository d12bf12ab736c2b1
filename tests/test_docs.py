# SPDX-License-Identifier: Apache-2.0
"""The files, functions and headings that the pages name exist; the tables of files are complete."""

import ast
import re
import tomllib
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
ARCHITECTURE = ROOT / "docs" / "architecture.md"
ONE_SCAN = ROOT / "docs" / "one_scan.md"
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").glob("*.md")])
CREATED = "services/mileage/"  # by docs/new_service.md, whose own test follows it
N_PLACES = 20  # of the table "Where is ..."
MIN_FUNCTIONS = 80  # that docs/one_scan.md names
OF_EVERY_SERVICE = {"__init__", "__main__", "service", "config"}

FILE = re.compile(r"`([\w./-]+/[\w./-]*\.py)`")
LINK = re.compile(r"\[[^\]]*\]\((?!http)(?P<file>[^)#]*)(?:#(?P<heading>[^)]+))?\)")
FILE_OR_FUNCTION = re.compile(r"`(?:(?P<file>[\w./-]+\.py)|(?P<function>[\w.]+)\(\))`")


def section(page: Path, title: str) -> str:
    """The text of a page between a second-level title and the next one."""
    return page.read_text(encoding="utf-8").split(f"\n## {title}\n", 1)[1].split("\n## ", 1)[0]


def rows(text: str) -> list[list[str]]:
    """The cells of the table rows in a text, without the two header rows of each table."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    header = [i for i, row in enumerate(cells) if all(set(cell) <= {"-", ":"} for cell in row)]
    return [row for i, row in enumerate(cells) if i not in header and i + 1 not in header]


@cache
def functions(path: Path) -> frozenset[str]:
    """Functions, classes and methods of a file: `name` and `Class.name`."""
    found = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            found.add(node.name)
        if isinstance(node, ast.ClassDef):
            found |= {f"{node.name}.{member.name}" for member in node.body if isinstance(member, ast.FunctionDef)}
    return frozenset(found)


def listed(files: str) -> set[str]:
    """Names of files and folders in a cell: `a` `b/`."""
    return set(re.findall(r"`([\w/]+)`", files)) - OF_EVERY_SERVICE


def in_folder(folder: Path) -> set[str]:
    """Names of the algorithm files and packages in a folder, as a cell of the tables has them."""
    files = {path.stem for path in folder.glob("*.py")} - OF_EVERY_SERVICE
    return files | {f"{path.parent.name}/" for path in folder.glob("*/__init__.py")}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_files_that_a_page_names_exist(page):
    named = FILE.findall(page.read_text(encoding="utf-8"))
    missing = [name for name in named if not name.startswith(CREATED) and not (ROOT / name).is_file()]
    assert not missing, f"{page.relative_to(ROOT)} names files that do not exist: {missing}"


def headings(page: Path) -> set[str]:
    """The anchors of a page's headings."""
    titles = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_link_leads_to_a_file_and_a_heading(page):
    for link in LINK.finditer(page.read_text(encoding="utf-8")):
        target = page.parent / link["file"] if link["file"] else page
        assert target.exists(), link[0]
        assert not link["heading"] or link["heading"] in headings(target), link[0]


def test_each_place_of_the_table_where_is_exists():
    table = rows(section(ARCHITECTURE, "Where is ..."))
    assert len(table) >= N_PLACES
    for place, answer in table:
        paths = FILE.findall(answer)
        assert paths, f"{place}: no file"
        assert all((ROOT / path).is_file() for path in paths), f"{place}: {answer}"


def test_the_table_of_services_lists_each_file():
    table = rows(section(ARCHITECTURE, "The services"))
    assert {name.strip("`") for name, _, _ in table} == {p.parent.name for p in ROOT.glob("services/*/service.py")}
    for name, _, files in table:
        if name != "`mapper`":
            assert listed(files) == in_folder(ROOT / "services" / name.strip("`")), name


def test_the_table_of_the_tools_has_the_packages_in_the_order_of_the_contract():
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"][
        "contracts"
    ]
    layers = next(contract["layers"] for contract in contracts if contract.get("containers") == ["zenav"])
    packages = {path.parent.name for path in ROOT.glob("zenav/*/__init__.py")}
    expected = [{name for name in layer.split(" | ") if name in packages} for layer in layers]
    table = rows(section(ARCHITECTURE, "The tools"))
    assert [set(names.replace("`", "").split()) for names, _ in table] == [names for names in expected if names]


def test_the_table_of_the_mapper_lists_each_file():
    table = [row for row in rows(section(ARCHITECTURE, "How the mapper maps")) if len(row) == 3]
    mapper = ROOT / "services" / "mapper"
    assert {folder.strip("`").removeprefix("services/mapper/") for folder, _, _ in table} == {
        "", *(f"{path.parent.relative_to(mapper)}/" for path in mapper.rglob("*/__init__.py"))
    }  # fmt: skip
    for folder, _, files in table:
        path = mapper / folder.strip("`").removeprefix("services/mapper/")
        assert listed(files) == {name for name in in_folder(path) if not name.endswith("/")}, folder


def test_the_functions_that_one_scan_names_exist():
    file, n = None, 0
    for found in FILE_OR_FUNCTION.finditer(ONE_SCAN.read_text(encoding="utf-8")):
        if found["file"]:
            file = ROOT / found["file"]
            continue
        assert file is not None, f"{found[0]} before any file"
        name = found["function"]
        assert name in functions(file), f"docs/one_scan.md: {file.relative_to(ROOT)} has no {name}"
        n += 1
    assert n >= MIN_FUNCTIONS
