# SPDX-License-Identifier: Apache-2.0
"""The form in which a message crosses: thinned where it is large, with an envelope of the link's own sequence."""

from dataclasses import replace
from typing import Any

import msgpack
import numpy as np

from shared import topics
from shared.codec import Envelope, decode, encode
from shared.messages import LaserScan, Path
from shared.topics import Topic
from shared.types import Int64s

MAX_PLAN_POSES, MAX_BEAMS = 60, 180


def crossing_payload(topic: Topic[Any], payload: bytes, session: str, sequence: int) -> bytes:
    """The message as it crosses; publisher and time of sending stay. Raises CodecError where the bytes are no message.

    session, sequence: of the link, so that a reader at the site counts what the link lost, not what it held back.
    """
    message, envelope = decode(topic.type, payload)
    crossing = Envelope(envelope.publisher, session, sequence, envelope.sent)
    if topic is topics.PLAN:
        return encode(thinned_plan(message), crossing)
    if topic in (topics.SCAN, topics.SCAN_2):
        return encode(thinned_scan(message), crossing)
    tree = msgpack.unpackb(payload)  # not encoded again: fields of a newer version stay
    return bytes(msgpack.packb({**tree, "@": crossing}))


def thinned_plan(path: Path) -> Path:
    """At most MAX_PLAN_POSES poses, among them the first and the last."""
    keep = _spread(len(path.xs), MAX_PLAN_POSES)
    return replace(path, xs=path.xs[keep], ys=path.ys[keep], yaws=path.yaws[keep])


def thinned_scan(scan: LaserScan) -> LaserScan:
    """Each n-th beam, at most MAX_BEAMS, without intensities."""
    step = max(1, -(-len(scan.ranges) // MAX_BEAMS))
    return replace(
        scan,
        angle_increment=scan.angle_increment * step,
        ranges=scan.ranges[::step],
        intensities=np.zeros(0, np.float32),
    )


def _spread(n: int, most: int) -> Int64s:
    """Indices of at most `most` of n items, evenly spread from the first to the last."""
    return np.arange(n) if n <= most else np.unique(np.linspace(0, n - 1, most).round().astype(np.int64))
