# SPDX-License-Identifier: Apache-2.0
"""Which tests `make test` gives to one worker together, where it runs them on several.

xdist's own marks for that (`xdist_group`) do nothing with pytest 9.2, which does not take the names that they make.
"""

from functools import cache
from pathlib import Path

from xdist.scheduler.loadscope import LoadScopeScheduling

ROOT = Path(__file__).resolve().parents[1]
STACK = "tests/stack/"
WITH_STACK = (STACK, "tests/page/test_page")


def group_of(test: str) -> str:
    """The name of a test's group; its own, where any worker will do.

    Tests with processes and sockets run one after the other: they would take each other's processor. What a module
    makes once for its tests is made once.
    """
    path = test.partition("::")[0]
    if path.startswith(WITH_STACK):
        return STACK
    return path if _makes_once(path) else test


@cache
def _makes_once(path: str) -> bool:
    return 'scope="module"' in (ROOT / path).read_text(encoding="utf-8")


class Groups(LoadScopeScheduling):
    """Gives whole groups to the workers, the largest first."""

    def _split_scope(self, nodeid: str) -> str:
        return group_of(nodeid)
