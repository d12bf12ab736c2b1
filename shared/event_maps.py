# SPDX-License-Identifier: Apache-2.0
"""Events of a shell as a stream of msgpack maps."""

from collections.abc import Iterator
from typing import Any

import msgpack


def event_maps(data: bytes) -> Iterator[dict[Any, Any]]:
    """The msgpack maps in some bytes, up to the first fault."""
    try:
        unpacker = msgpack.Unpacker()
        unpacker.feed(data)
        for event in unpacker:
            if type(event) is dict:
                yield event
    except Exception:  # msgpack raises a dozen kinds on foreign bytes: all mean the same here
        return
