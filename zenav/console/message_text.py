# SPDX-License-Identifier: Apache-2.0
"""Messages as JSON values and as text for people."""

from dataclasses import fields, is_dataclass
from enum import Enum
from math import isfinite
from typing import Any

import numpy as np

from shared.codec import Envelope
from shared.geometry import Pose2
from shared.messages import Message

MAX_VALUES_SHOWN = 8  # array values that people see


def json_value(value: Any, few: int | None = None) -> Any:
    """A message's value as JSON knows it; NaN is null. Arrays and lists longer than `few` become a few values' text."""
    if isinstance(value, Pose2):
        return [round(value.x, 4), round(value.y, 4), round(value.yaw, 4)]
    if is_dataclass(value):
        return {field.name: json_value(getattr(value, field.name), few) for field in fields(value)}
    if isinstance(value, np.ndarray):
        flat = value.ravel()
        if few is not None and len(flat) > few:
            head = ", ".join(
                "-" if isinstance(v, float) and not isfinite(v) else f"{v:.4g}" for v in flat[:few].tolist()
            )
            return f"[{head}, ...] {'x'.join(map(str, value.shape))}"
        return [json_value(v, few) for v in value.tolist()]
    if isinstance(value, bytes):
        return f"{len(value)} bytes" if few is not None else value.hex()
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, float):
        return (round(value, 6) if few is not None else value) if isfinite(value) else None
    if isinstance(value, (tuple, list)):
        return [json_value(v, few) for v in value]
    return value


def message_text(message: Message, envelope: Envelope) -> str:
    """A message for people: a line a field."""
    lines = [f"{name}: {_value_text(value)}" for name, value in json_value(message, MAX_VALUES_SHOWN).items()]
    late = (envelope.sent - message.stamp) / 1e6
    lines.append(
        f"# {type(message).__name__} {envelope.sequence} by {envelope.publisher}, sent {late:.1f} ms after its stamp"
    )
    return "\n".join(lines)


def _value_text(value: Any) -> str:
    return "-" if value is None else str(value).lower() if isinstance(value, bool) else str(value)
