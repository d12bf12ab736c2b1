# SPDX-License-Identifier: Apache-2.0
"""Tables of results: on the terminal, and as Markdown."""

from collections.abc import Iterable, Sequence


def show_table(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Shows a table on stdout; the first column is a name, the others are numbers."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title, title_justify="left", box=None, pad_edge=False)
    for i, column in enumerate(columns):
        table.add_column(column, justify="right" if i else "left", overflow="fold")
    for row in rows:
        table.add_row(*row)
    console = Console(markup=False, emoji=False)  # a name like a[b].mcap or :1: stays what it is
    if not console.is_terminal:
        console.width = 160  # a log's lines do not wrap
    console.print(table)


def markdown_table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> list[str]:
    """The lines of a Markdown table. head: titles of the columns."""
    lines = [head, tuple("---" for _ in head), *rows]
    return ["| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in row) + " |" for row in lines]
