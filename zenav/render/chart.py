# SPDX-License-Identifier: Apache-2.0
"""Curves and dots with axes, as a PNG: what a calibration found, for people."""

from dataclasses import dataclass, field
from io import BytesIO
from math import ceil, floor, log10
from typing import Any

import numpy as np

from shared.types import Float64s

Colour = tuple[int, int, int]

INK, FAINT, PAPER = (40, 44, 52), (222, 226, 230), (255, 255, 255)
BEFORE, AFTER, TRUE, OTHER = (214, 62, 48), (30, 90, 200), (30, 140, 60), (150, 110, 30)
WIDTH, HEIGHT = 660, 560
LEFT, RIGHT, TOP, BOTTOM = 72, 18, 40, 56
SIZE = 14
MANY_POINTS = 500  # points from which they are drawn small


@dataclass
class Chart:
    """One pair of axes. `equal`: a metre is as long both ways."""

    title: str
    x: str
    y: str
    equal: bool = False
    _marks: list[tuple[Float64s, Float64s, Colour, str, bool]] = field(default_factory=list)

    def line(self, xs: Any, ys: Any, colour: Colour, label: str = "") -> "Chart":
        """A curve through points (n,), (n,); NaN interrupts it."""
        return self._add(xs, ys, colour, label, False)

    def dots(self, xs: Any, ys: Any, colour: Colour, label: str = "") -> "Chart":
        """Points (n,), (n,)."""
        return self._add(xs, ys, colour, label, True)

    def _add(self, xs: Any, ys: Any, colour: Colour, label: str, as_dots: bool) -> "Chart":
        self._marks.append((np.asarray(xs, float).ravel(), np.asarray(ys, float).ravel(), colour, label, as_dots))
        return self

    def draw(self, draw: Any, at: tuple[int, int], font: Any) -> None:
        """Onto a picture, with the corner at `at` (pixels)."""
        x0, y0 = at[0] + LEFT, at[1] + TOP
        x1, y1 = at[0] + WIDTH - RIGHT, at[1] + HEIGHT - BOTTOM
        (low_x, high_x), (low_y, high_y) = self._limits((x1 - x0) / (y1 - y0))
        px, py = (x1 - x0) / (high_x - low_x), (y1 - y0) / (high_y - low_y)
        for value in ticks(low_x, high_x):
            x = x0 + (value - low_x) * px
            draw.line((x, y0, x, y1), fill=FAINT)
            draw.text((x, y1 + 5), tick_text(value), fill=INK, font=font, anchor="ma")
        for value in ticks(low_y, high_y):
            y = y1 - (value - low_y) * py
            draw.line((x0, y, x1, y), fill=FAINT)
            draw.text((x0 - 6, y), tick_text(value), fill=INK, font=font, anchor="rm")
        draw.rectangle((x0, y0, x1, y1), outline=INK)
        draw.text(((x0 + x1) / 2, at[1] + 10), self.title, fill=INK, font=font, anchor="ma")
        draw.text(((x0 + x1) / 2, y1 + 28), self.x, fill=INK, font=font, anchor="ma")
        draw.text((at[0] + 8, y0 - 8), self.y, fill=INK, font=font, anchor="lb")
        for xs, ys, colour, _, as_dots in self._marks:
            points = [(x0 + (a - low_x) * px, y1 - (b - low_y) * py) for a, b in zip(xs.tolist(), ys.tolist())]
            if as_dots:
                r = 3 if len(points) <= MANY_POINTS else 1
                for a, b in points:
                    if a == a and b == b:
                        draw.ellipse((a - r, b - r, a + r, b + r), fill=colour)
                continue
            for part in _parts(points):
                draw.line(part, fill=colour, width=2, joint="curve")
        row = y0 + 6
        for colour, label in dict.fromkeys((m[2], m[3]) for m in self._marks if m[3]):
            draw.rectangle((x1 - 14, row + 3, x1 - 6, row + 11), fill=colour)
            draw.text((x1 - 20, row), label, fill=INK, font=font, anchor="ra")
            row += SIZE + 5

    def _limits(self, shape: float) -> tuple[tuple[float, float], tuple[float, float]]:
        xs = np.concatenate([m[0] for m in self._marks] or [np.zeros(1)])
        ys = np.concatenate([m[1] for m in self._marks] or [np.zeros(1)])
        spans = [_span(xs), _span(ys)]
        if self.equal:
            wide, high = spans[0][1] - spans[0][0], spans[1][1] - spans[1][0]
            spans[0] = _widened(spans[0], max(wide, high * shape))
            spans[1] = _widened(spans[1], max(high, wide / shape))
        return spans[0], spans[1]


def charts_png(charts: list[Chart]) -> bytes:
    """A PNG with the charts side by side."""
    from PIL import Image, ImageDraw, ImageFont

    image = Image.new("RGB", (WIDTH * len(charts), HEIGHT), PAPER)
    draw, font = ImageDraw.Draw(image), ImageFont.load_default(SIZE)
    for i, chart in enumerate(charts):
        chart.draw(draw, (i * WIDTH, 0), font)
    stream = BytesIO()
    image.save(stream, "PNG")
    return stream.getvalue()


def ticks(low: float, high: float) -> list[float]:
    """Round numbers between two bounds, about six of them."""
    raw = (high - low) / 6
    power = 10.0 ** floor(log10(raw))
    step = next(step for step in (1, 2, 2.5, 5, 10) if step * power >= raw * 0.999) * power
    first = ceil(low / step - 1e-9)
    return [i * step for i in range(first, floor(high / step + 1e-9) + 1)]


def tick_text(value: float) -> str:
    """A tick's number."""
    return f"{value:.6g}" if abs(value) > 1e-12 else "0"


def _span(values: Float64s) -> tuple[float, float]:
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
    alike = high - low <= 1e-9 * max(abs(low), abs(high))
    margin = (0.5 * abs(low) or 0.5) if alike else 0.06 * (high - low)
    return low - margin, high + margin


def _widened(span: tuple[float, float], to: float) -> tuple[float, float]:
    more = (to - (span[1] - span[0])) / 2
    return span[0] - more, span[1] + more


def _parts(points: list[tuple[float, float]]) -> list[list[tuple[float, float]]]:
    """The runs of points without NaN, of two at least."""
    parts: list[list[tuple[float, float]]] = [[]]
    for a, b in points:
        if a == a and b == b:
            parts[-1].append((a, b))
        elif parts[-1]:
            parts.append([])
    return [part for part in parts if len(part) > 1]
