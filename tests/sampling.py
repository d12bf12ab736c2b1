# SPDX-License-Identifier: Apache-2.0
"""Half of the cases of tests that have several, the other half on the next day: for CI on a slow machine."""

from collections import defaultdict
from collections.abc import Iterable
from zlib import crc32

FEW = 4
"""A test with fewer cases is run with all of them."""


def left_out(tests: Iterable[str], day: int) -> set[str]:
    """Which tests, named as pytest names them, do not run on this day (a number that rises by 1 a day)."""
    cases: defaultdict[str, list[str]] = defaultdict(list)
    for test in tests:
        cases[test.partition("[")[0]].append(test)
    return {
        case
        for name, of_one in cases.items()
        if len(of_one) >= FEW
        for case in of_one[(crc32(name.encode()) + day) % 2 :: 2]
    }
