# SPDX-License-Identifier: Apache-2.0
"""What a batch's child process returns. Not in child.py, which is `__main__` there."""

from typing import Any, NamedTuple


class ChildReply(NamedTuple):
    """The value of the work; or the exception in words, and whether memory was lacking."""

    value: Any = None
    error: str = ""
    out_of_memory: bool = False
