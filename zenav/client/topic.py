# SPDX-License-Identifier: Apache-2.0
"""`zenav topic`: what goes over the wire, as text."""

import json
import sys
import threading
import time
from typing import Any

import numpy as np

from shared.codec import CodecError, decode
from shared.config import UserError, load_robot, nearest
from shared.messages import Message
from shared.runners.transport import LatchedReader, stack_address
from shared.topics import KEYS, Topic, topic_of
from zenav.client import Client
from zenav.console.message_text import json_value, message_text
from zenav.console.shutdown import stop_on_signal

MAX_SILENCE_S = 5.0  # s of silence after which the command says that no message comes


def topic_named(key: str) -> tuple[str, Topic[Message]]:
    """The key and its topic. Raises UserError with the nearest key where there is none."""
    topic = topic_of(key)
    if topic is None or key not in KEYS:
        raise UserError(f"{key} is not a topic", nearest(key, KEYS))
    return key, topic


def echo(robot: str, stack: str, key: str, number: int, as_json: bool) -> int:
    """Writes messages as they come, `number` of them or until Ctrl-C; 1 where none came."""
    key, topic = topic_named(key)
    n_shown, ready, waiting = 0, threading.Condition(), list[bytes]()

    def file(payload: bytes) -> None:
        with ready:
            waiting.append(payload)
            del waiting[:-100]  # a terminal slower than the topic sees the newest
            ready.notify()

    with stop_on_signal() as stop, Client(load_robot(robot).robot.name, stack_address(stack)) as client:
        client.listen_raw(key, lambda _, payload: file(payload))
        latched_reader = LatchedReader(client.session, f"{client.robot}/{key}", file) if topic.latched else None
        last = time.monotonic()
        while not stop.is_set() and (number == 0 or n_shown < number):
            with ready:
                ready.wait_for(lambda: waiting, 0.1)
                payloads, waiting[:] = list(waiting), []
            if not payloads and time.monotonic() - last > MAX_SILENCE_S and topic.hz:
                if number:
                    break
                sys.stderr.write(f"nothing on {key} for {MAX_SILENCE_S:g} s\n")
                last = time.monotonic()
            for payload in payloads[: number - n_shown if number else None]:
                n_shown, last = n_shown + 1, time.monotonic()
                _write(topic, payload, as_json)
        del latched_reader
    if not n_shown and number:
        raise UserError(f"nothing came on {key}", does_it_run(key, topic))
    return 0


def measure_rate(robot: str, stack: str, key: str, seconds: float, as_json: bool) -> int:
    """Listens for a while, then writes rate, jitter, age and size; 1 where fewer than two messages came."""
    key, topic = topic_named(key)
    arrivals: list[float] = []
    ages: list[float] = []
    sizes: list[int] = []
    with stop_on_signal() as stop, Client(load_robot(robot).robot.name, stack_address(stack)) as client:

        def file(payload: bytes) -> None:
            arrivals.append(time.monotonic())
            sizes.append(len(payload))
            try:
                ages.append((client.now() - decode(topic.type, payload)[0].stamp) / 1e9)
            except CodecError:
                return

        client.listen_raw(key, lambda _, payload: file(payload))
        stop.wait(seconds)
    if len(arrivals) < 2:
        raise UserError(
            f"{len(arrivals)} message{'s' if len(arrivals) != 1 else ''} on {key} in {seconds:g} s",
            (f"expected {topic.hz:g} a second; " if topic.hz else "") + does_it_run(key, topic),
        )
    row = rates(np.array(arrivals), np.array(ages), np.array(sizes))
    expected = f"expected {topic.hz:g}" if topic.hz else "an event"
    if as_json:
        sys.stdout.write(json.dumps({"key": key, **row}) + "\n")
    else:
        sys.stdout.write(
            f"{key}: {row['hz']:.2f} Hz ({expected}), jitter {row['jitter_ms']:.1f} ms, longest gap "
            f"{row['longest_gap_ms']:.1f} ms, age {row['age_ms']:.1f} ms (largest {row['largest_age_ms']:.1f}), "
            f"{row['bytes']:.0f} bytes\n"
        )
    return 0


def does_it_run(key: str, topic: Topic[Message]) -> str:
    """A hint for a key without messages."""
    if not topic.hz:
        return "it comes only when something happens"
    return f"does {topic.by.replace(' ', ' or ') if topic.by != '*' else key.partition('/')[2]} run? zenav doctor"


def rates(arrivals: Any, ages: Any, sizes: Any) -> dict[str, float]:
    """Figures of a topic. arrivals: (n >= 2,) s; ages: (m,) s since the stamp; sizes: (n,) bytes."""
    gaps = np.diff(arrivals)
    return {
        "n": len(arrivals),
        "hz": float(len(gaps) / max(arrivals[-1] - arrivals[0], 1e-9)),
        "jitter_ms": float(gaps.std() * 1e3),
        "longest_gap_ms": float(gaps.max() * 1e3),
        "age_ms": float(np.median(ages) * 1e3) if len(ages) else 0.0,
        "largest_age_ms": float(np.max(ages) * 1e3) if len(ages) else 0.0,
        "bytes": float(np.mean(sizes)),
    }


def _write(topic: Topic[Message], payload: bytes, as_json: bool) -> None:
    try:
        message, envelope = decode(topic.type, payload)
    except CodecError as error:
        sys.stderr.write(f"{len(payload)} bytes that are no {topic.type.__name__}: {error}\n")
        return
    if as_json:
        about = {"publisher": envelope.publisher, "sequence": envelope.sequence, "sent": envelope.sent}
        sys.stdout.write(json.dumps({**json_value(message), "@": about}) + "\n")
    else:
        sys.stdout.write(message_text(message, envelope) + "\n---\n")
    sys.stdout.flush()
