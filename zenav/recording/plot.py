# SPDX-License-Identifier: Apache-2.0
"""`zenav recording plot`: numbers in messages over time, as a picture or in the terminal."""

import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from shared import topics
from shared.codec import CodecError, Field, decode, fields_of
from shared.config import UserError, nearest
from shared.geometry import Pose2
from shared.messages import Message
from shared.recording import Recording
from shared.types import NS_PER_S, Float64s
from zenav.recording.opening import open_recording
from zenav.recording.selection import begin_of, keys_in, time_range
from zenav.render.chart import AFTER, BEFORE, OTHER, TRUE, Chart, charts_png, tick_text

COLOURS = AFTER, BEFORE, TRUE, OTHER
NAMES = "blue", "red", "green", "yellow"
WIDTH, HEIGHT, MARGIN = 120, 20, 14  # characters; the margin is for the numbers at the edge
BRAILLE = 0x2800  # the first of the 256 characters of 2 x 4 dots
OF_ARRAYS: dict[str, Callable[[Any], Any]] = {"min": np.min, "max": np.max, "mean": np.mean}
_PATH = re.compile(r"(\w+)((?:\.\w+)*)(?:\[(\d+)\])?")


@dataclass(frozen=True, slots=True)
class PlotSeries:
    """One number over time: (n,) s since the start, (n,) in its unit; NaN where it was not a number."""

    name: str
    unit: str
    times: Float64s
    values: Float64s


def plot(path: Path, fields: list[str], out: Path | None, begin: float | None, end: float | None) -> int:
    """Draws fields like pose:map_from_base.x; into the PNG `out`, or into the terminal."""
    recording = open_recording(path)
    plotted = series(recording, fields, *time_range(recording, begin, end))
    units = dict.fromkeys(row.unit for row in plotted)
    if out is None:
        from rich.console import Console

        console = Console()
        for unit in units:
            for line in braille_lines([row for row in plotted if row.unit == unit], min(console.width - MARGIN, WIDTH)):
                console.print(line, no_wrap=True, overflow="crop")
        return 0
    charts = []
    for unit in units:
        chart = Chart(path.name, "s", unit)
        for i, row in enumerate(row for row in plotted if row.unit == unit):
            chart.line(row.times, row.values, COLOURS[i % len(COLOURS)], row.name)
        charts.append(chart)
    try:
        out.write_bytes(charts_png(charts))
    except OSError as error:
        raise UserError(f"cannot write {out}: {error.strerror}", "choose another --out") from None
    sys.stdout.write(f"{out}\n")
    return 0


def series(recording: Recording, fields: list[str], begin: int | None, end: int | None) -> list[PlotSeries]:
    """The fields' numbers between two log_times. Raises UserError where one is not in it, or is no number."""
    wanted = [_asked(field) for field in fields]
    keys_in(recording, [key for key, *_ in wanted])
    times: list[list[float]] = [[] for _ in wanted]
    values: list[list[float]] = [[] for _ in wanted]
    zero = begin_of(recording)
    for entry in recording.entries({key for key, *_ in wanted}, begin, end):
        try:
            message, _ = decode(topics.topic_of(entry.key).type, entry.payload)  # type: ignore[union-attr]  # _asked
        except CodecError:
            continue
        for i, (key, field, path, index) in enumerate(wanted):
            if key == entry.key:
                times[i].append((entry.log_time - zero) / NS_PER_S)
                values[i].append(_number(getattr(message, field.name), path, index))
    plotted = []
    for (_, field, *_), text, t, v in zip(wanted, fields, times, values):
        if not t or not np.isfinite(v).any():
            hint = f"of an array say which: {text}[0], {text}.min, .max, .mean; zenav recording cat shows what it holds"
            raise UserError(f"{recording.path} has no number for {text}", hint)
        plotted.append(PlotSeries(text, _unit(field, text), np.array(t), np.array(v)))
    return plotted


def _asked(text: str) -> tuple[str, Field, list[str], int | None]:
    """Key, field, names of what is inside it, index. Raises UserError where the registry knows no such number."""
    key, colon, rest = text.rpartition(":")
    if not colon:
        raise UserError(f"{text!r} names no field", "write topic:field, like cmd/vel:v or pose:map_from_base.x")
    topic = topics.topic_of(key)
    if topic is None or key not in topics.KEYS:
        raise UserError(f"{key} is not a topic", nearest(key, topics.KEYS))
    match = _PATH.fullmatch(rest)
    rows = {row.name: row for row in fields_of(topic.type)}
    if match is None or match[1] not in rows:
        raise UserError(f"{key} has no field {rest}", nearest(match[1] if match else rest, tuple(rows)))
    inner, index = [name for name in match[2].split(".") if name], int(match[3]) if match[3] else None
    return key, rows[match[1]], inner, index


def _number(value: Any, inner: list[str], index: int | None) -> float:
    """The number that is asked for; NaN where there is none."""
    for name in inner:
        if isinstance(value, np.ndarray):
            whole = value[np.isfinite(value)] if value.dtype.kind == "f" else value
            value = float(OF_ARRAYS[name](whole)) if name in OF_ARRAYS and len(whole) else None
        elif isinstance(value, (Message, Pose2)):
            value = getattr(value, name, None)
    if isinstance(value, np.ndarray) and index is not None and index < value.size:
        value = value.ravel()[index]
    return float(value) if isinstance(value, (int, float, np.number)) else float("nan")


def _unit(field: Field, text: str) -> str:
    units = field.unit.split(", ")
    if field.kind is Pose2 and len(units) == 3:
        return units[2] if text.endswith(".yaw") else units[0]
    return field.unit


def braille_lines(rows: list[PlotSeries], width: int) -> list[str]:
    """Curves of one unit as lines for rich: two by four dots a character."""
    width = max(width, 20)
    times = np.concatenate([row.times for row in rows])
    values = np.concatenate([row.values for row in rows])
    t0, t1 = float(times.min()), max(float(times.max()), float(times.min()) + 1e-9)
    finite = values[np.isfinite(values)]  # a range without an echo may be infinite
    low, high = float(finite.min()), float(finite.max())
    if high - low < 1e-12:
        low, high = low - 0.5, high + 0.5
    dots = np.zeros((HEIGHT, width), np.uint8)
    colour = np.zeros((HEIGHT, width), np.int8)
    bits = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]], np.uint8)  # of a braille character
    for i, row in enumerate(rows):
        fine = np.isfinite(row.values)
        x = ((row.times[fine] - t0) / (t1 - t0) * (2 * width - 1)).round().astype(int)
        y = ((high - row.values[fine]) / (high - low) * (4 * HEIGHT - 1)).round().astype(int)
        np.bitwise_or.at(dots, (y // 4, x // 2), bits[y % 4, x % 2])
        colour[y // 4, x // 2] = i
    edge = max(len(tick_text(low)), len(tick_text(high)))
    lines = [", ".join(f"[{NAMES[i % len(NAMES)]}]{row.name}[/]" for i, row in enumerate(rows)) + f", {rows[0].unit}"]
    for line in range(HEIGHT):
        label = tick_text(high) if line == 0 else tick_text(low) if line == HEIGHT - 1 else ""
        cells = "".join(
            f"[{NAMES[of % len(NAMES)]}]{chr(BRAILLE + dot)}[/]" if dot else " "
            for dot, of in zip(dots[line].tolist(), colour[line].tolist())
        )
        lines.append(f"{label:>{edge}} |{cells}")
    left, right = f"{t0:.1f}", f"{t1:.1f} s"
    lines.append(" " * (edge + 2) + left + right.rjust(width - len(left)))
    return lines
