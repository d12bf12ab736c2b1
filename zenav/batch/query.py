# SPDX-License-Identifier: Apache-2.0
"""Expressions over the catalogue, like `robot=red and contact and duration>60`: to a condition of SQL with values.

    or := and ('or' and)*      and := not ('and' not)*      not := 'not' not | '(' or ')' | column [operator value]

A column alone holds where it is true, not zero or not empty. `=` of a list holds where the value is in it, and `~`
where a text contains the value.
"""

import re
from datetime import datetime
from typing import Any

from shared.config import UserError, nearest
from zenav.batch.catalogue import COLUMNS

TOKEN = re.compile(r"\s*(?:(?P<text>'[^']*'|\"[^\"]*\")|(?P<sign>!=|<=|>=|[=<>~()])|(?P<word>[^\s=<>~()!'\"]+))")
OPERATORS = ("=", "!=", "<", "<=", ">", ">=", "~")
Condition = tuple[str, list[Any]]


def condition(expression: str) -> Condition:
    """A condition with ? for its values, and the values. Raises UserError that names what is wrong."""
    parser = _Parser(_tokens(expression))
    if not parser.left:
        return "true", []
    found = parser.any_of()
    if parser.left:
        raise UserError(f"{parser.left[0]!r} is too much", "join conditions by and, or, not and brackets")
    return found


def _tokens(expression: str) -> list[str]:
    tokens, at = [], 0
    text = expression.rstrip()
    while at < len(text):
        match = TOKEN.match(text, at)
        if match is None:
            raise UserError(f"{text[at:]!r} is no condition", "write one like robot=red and duration>60")
        tokens.append(match.group(0).strip())
        at = match.end()
    return tokens


class _Parser:
    def __init__(self, tokens: list[str]) -> None:
        self.left = tokens

    def any_of(self) -> Condition:
        return self._joined("or", lambda: self._joined("and", self._one))

    def _joined(self, word: str, part: Any) -> Condition:
        text, values = part()
        while self.left and self.left[0].lower() == word:
            self.left.pop(0)
            next_text, next_values = part()
            text, values = f"{text} {word} {next_text}", [*values, *next_values]
        return f"({text})", values

    def _one(self) -> Condition:
        token = self._next("a column")
        if token.lower() == "not":
            text, values = self._one()
            return f"not {text}", values
        if token == "(":
            found = self.any_of()
            if self._next("a closing bracket") != ")":
                raise UserError("a closing bracket is missing", "write one ) for each (")
            return found
        if token not in COLUMNS:
            raise UserError(f"{token!r} is no column of the catalogue", nearest(token, tuple(COLUMNS)))
        if self.left and self.left[0] in OPERATORS:
            return _comparison(token, self.left.pop(0), self._next("a value"))
        return _is_set(token), []

    def _next(self, what: str) -> str:
        if not self.left:
            raise UserError(f"{what} is missing at the end", "write conditions like robot=red and duration>60")
        return self.left.pop(0)


def _is_set(column: str) -> str:
    type_ = COLUMNS[column]
    if type_ == "BOOLEAN":
        return f"coalesce({column}, false)"
    if type_.endswith("[]"):
        return f"coalesce(len({column}), 0) > 0"
    if type_ == "TIMESTAMP":
        return f"{column} IS NOT NULL"
    return f"coalesce({column}, '') <> ''" if type_ == "VARCHAR" else f"coalesce({column}, 0) <> 0"


def _comparison(column: str, operator: str, text: str) -> Condition:
    """Unknown figures, as of a recording that could not be read, fulfil no comparison."""
    type_, value = COLUMNS[column], text.strip("'\"")
    if type_.endswith("[]"):
        if operator not in ("=", "!="):
            raise UserError(f"{column} is a list: {operator} does not compare it", f"write {column}={value}")
        return f"{'not ' if operator == '!=' else ''}list_contains({column}, ?)", [value]
    if operator == "~":
        return f"contains(lower(CAST({column} AS VARCHAR)), lower(?))", [value]
    if type_ == "VARCHAR":
        return f"{column} {operator} ?", [value]
    as_type = "DOUBLE" if type_ == "BIGINT" else type_  # a value such as 0.5 would be rounded
    return f"{column} {operator} TRY_CAST(? AS {as_type})", [_checked(column, type_, value)]


def _checked(column: str, type_: str, value: str) -> str:
    """The value, if it is one of the column's type; DuckDB converts it."""
    number = re.fullmatch(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", value)
    if type_ in ("DOUBLE", "BIGINT") and not number:
        raise UserError(f"{value!r} is no number for {column}", f"write {column}>60")
    if type_ == "BOOLEAN" and value not in ("true", "false"):
        raise UserError(f"{value!r} is not true or false", f"write {column}, or not {column}")
    if type_ == "TIMESTAMP" and not _is_time(value):
        raise UserError(f"{value!r} is no time", f"write {column}>2026-11-01 or {column}>'2026-11-01 10:30'; UTC")
    return value


def _is_time(value: str) -> bool:
    """Whether it is a date or a time that the calendar has."""
    if not re.fullmatch(r"\d{4}-\d\d-\d\d([T ]\d\d:\d\d(:\d\d)?)?", value):
        return False
    try:
        datetime.fromisoformat(value)
    except ValueError:
        return False
    return True
