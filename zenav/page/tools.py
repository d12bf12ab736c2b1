# SPDX-License-Identifier: Apache-2.0
"""The process that works for pages: `python -m zenav.page.tools --robot R --stack S`, started by the page's server.

In both directions: four bytes of length (little-endian), then a msgpack map: {"op", "args"}, and the fields of a reply.
It ends with its input. The page's server imports no tool of zenav: this command line is all that it knows of them.
"""

import shared.repeatable  # noqa: F401  # before numpy

# isort: split
import os
import sys
import traceback
from collections.abc import Callable
from typing import Any, BinaryIO

import msgpack
import zenoh

from shared.config import UserError
from zenav.client.navigation_client import RequestRefusedError
from zenav.page import maps, places, recordings, settings
from zenav.page.replay import REPLAYS
from zenav.page.target import PageTarget, Values

REFUSED = "refused"
"""The reason of a refusal that is no reason of shared/reasons.py."""
MAX_ORDER = 128 * 2**20  # bytes: an uploaded map

OPERATIONS: dict[str, Callable[[PageTarget, Values], Any]] = {
    "maps": maps.maps,
    "map_save": maps.save,
    "map_load": maps.load,
    "map_rename": maps.rename,
    "map_delete": maps.delete,
    "map_download": maps.download,
    "map_upload": maps.upload,
    "set_pose": maps.set_pose,
    "places": places.places,
    "place_set": places.set_place,
    "place_delete": places.delete,
    "recordings": recordings.recordings,
    "recording_path": recordings.path_of,
    "recording_delete": recordings.delete,
    "replay_open": REPLAYS.open,
    "replay_at": REPLAYS.at,
    "settings": settings.settings,
    "setting_set": settings.set_setting,
}


def run(target: PageTarget, op: str, values: Values) -> Values:
    """The fields of the reply to an operation, but for its `id`."""
    try:
        data = OPERATIONS[op](target, values)
    except RequestRefusedError as error:
        return _refusal(error.code, error.what, error.hint)
    except UserError as error:
        return _refusal(REFUSED, error.what, error.hint)
    except OSError as error:
        return _refusal(REFUSED, f"{op}: {error.strerror or error}", "check the disk and the folder's permissions")
    except zenoh.ZError as error:
        return _refusal(REFUSED, f"{op}: no connection to the stack: {error}", "is it running?")
    except Exception as error:  # a bug: the page hears of it, the process goes on, the log has the trace
        traceback.print_exc()
        return _refusal(REFUSED, f"{op}: {type(error).__name__}: {error}", "this is a bug: see the dashboard's log")
    return {"accepted": True, "reason": "", "detail": "", "hint": "", "data": data}


def serve(target: PageTarget, orders: BinaryIO, replies: BinaryIO) -> None:
    """Works until the orders end."""
    while len(head := orders.read(4)) == 4:
        length = int.from_bytes(head, "little")
        if length > MAX_ORDER:
            return
        order = msgpack.unpackb(orders.read(length))
        reply = bytes(msgpack.packb(run(target, order["op"], order["args"])))
        replies.write(len(reply).to_bytes(4, "little") + reply)
        replies.flush()


def main() -> None:
    """The process. What its operations print is for the log: stdout carries replies only."""
    target = PageTarget.of(sys.argv[1:])
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    serve(target, sys.stdin.buffer, replies)
    os._exit(0)  # Zenoh's threads are not daemons


def _refusal(reason: str, detail: str, hint: str) -> Values:
    return {"accepted": False, "reason": reason, "detail": detail, "hint": hint, "data": None}


if __name__ == "__main__":
    main()
