# SPDX-License-Identifier: Apache-2.0
"""`zenav explore --with`: the names of the other robots, and what is passed on to the own one."""

from types import SimpleNamespace

import pytest
import zenoh

from shared import sample_messages as sample
from shared import topics
from shared.config import UserError
from shared.runners.transport import stack_address
from zenav.client.shared_exploring import ShareRelay, other_stacks

SHARE = sample.exploration_share(1, "blue", ("red",))


def test_another_robot_is_in_the_same_stack_or_in_one_that_is_named():
    stacks = other_stacks(["blue", "green@2"], "red", "1")
    assert stacks == {"blue": stack_address("1"), "green": stack_address("2")}


@pytest.mark.parametrize("names", [["red"], ["blue", "blue"], ["Blue robot"], [""], [f"robot_{n}" for n in range(21)]])
def test_a_name_that_is_wrong_twice_or_its_own_is_refused_with_a_hint(names):
    with pytest.raises(UserError) as refused:
        other_stacks(names, "red", "0")
    assert refused.value.hint


def test_what_others_say_is_published_for_the_own_robot_until_its_session_ends():
    published = []
    relay = ShareRelay(SimpleNamespace(publish=published.append))
    relay.add(SHARE)
    assert published == [topics.OTHERS_SHARE(SHARE)]

    def closed(publication):
        raise zenoh.ZError("closed")

    ShareRelay(SimpleNamespace(publish=closed)).add(SHARE)
