# SPDX-License-Identifier: Apache-2.0
"""Which cases of tests that have several come last, and are left out when CI's time is up: others on each day."""

from collections import defaultdict
from collections.abc import Iterable
from zlib import crc32

FEW = 4
"""Of a test with fewer cases none comes last."""
DAYS = 3
"""Each case comes first on one of so many days."""


def last_cases(tests: Iterable[str], day: int) -> set[str]:
    """Which tests, named as pytest names them, come last on this day (a number that rises by 1 a day)."""
    cases: defaultdict[str, list[str]] = defaultdict(list)
    for test in tests:
        cases[test.partition("[")[0]].append(test)
    return {
        case
        for name, of_one in cases.items()
        if len(of_one) >= FEW
        for i, case in enumerate(of_one)
        if (i + crc32(name.encode()) + day) % DAYS
    }
