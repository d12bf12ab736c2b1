# SPDX-License-Identifier: Apache-2.0
"""How many bytes an object holds back: what a decoder of a line may keep of noise."""

import gc
from types import FunctionType, ModuleType

NOT_ITS_OWN = (type, ModuleType, FunctionType)


def held_bytes(thing: object) -> int:
    """The length of all byte strings that can be reached from an object, but for those of code and classes."""
    seen, waiting, total = set(), [thing], 0
    while waiting:
        one = waiting.pop()
        if id(one) in seen or isinstance(one, NOT_ITS_OWN):
            continue
        seen.add(id(one))
        if isinstance(one, bytes | bytearray):
            total += len(one)
        else:
            waiting += gc.get_referents(one)
    return total
