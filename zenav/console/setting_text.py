# SPDX-License-Identifier: Apache-2.0
"""Bounds and unit of a setting, from its field in the configuration's model."""

from typing import NamedTuple

import annotated_types
from pydantic.fields import FieldInfo

UNITS = frozenset(("m", "s", "rad", "m/s", "rad/s", "m/s^2", "rad/s^2", "1/m", "MB", "V", "m^2", "percent"))


class Bounds(NamedTuple):
    """Lowest and highest value, None without one; and whether each is excluded."""

    low: float | None = None
    high: float | None = None
    low_excluded: bool = False
    high_excluded: bool = False


def bounds_of(field: FieldInfo) -> Bounds:
    """The bounds from a field's constraints."""
    found = Bounds()
    for mark in field.metadata:
        if isinstance(mark, annotated_types.Ge):
            found = found._replace(low=float(mark.ge))  # type: ignore[arg-type]  # of numbers only
        elif isinstance(mark, annotated_types.Gt):
            found = found._replace(low=float(mark.gt), low_excluded=True)  # type: ignore[arg-type]  # as above
        elif isinstance(mark, annotated_types.Le):
            found = found._replace(high=float(mark.le))  # type: ignore[arg-type]  # as above
        elif isinstance(mark, annotated_types.Lt):
            found = found._replace(high=float(mark.lt), high_excluded=True)  # type: ignore[arg-type]  # as above
    return found


def bounds_text(field: FieldInfo) -> str:
    """`0 < .. <= 10`, from a field's constraints; empty where it has none."""
    bounds = bounds_of(field)
    low = f"{bounds.low:g} {'<' if bounds.low_excluded else '<='} " if bounds.low is not None else ""
    high = f" {'<' if bounds.high_excluded else '<='} {bounds.high:g}" if bounds.high is not None else ""
    return f"{low}..{high}" if low or high else ""


def unit_of(field: FieldInfo) -> str:
    """The unit, with which a description begins; empty where it has none."""
    words = (field.description or "").replace(",", " ").replace(":", " ").replace(";", " ").split()
    return words[0] if words and words[0] in UNITS else ""
