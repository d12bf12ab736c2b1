# SPDX-License-Identifier: Apache-2.0
"""Any valid messages, in any order, at any time: no service raises, and what it publishes is valid."""

from dataclasses import replace

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from shared.config import configured, load_robot
from shared.service import Job, Log, handlers
from shared.topics import Publication
from tests.strategies import faults, publications
from zenav.stack.service_loader import build_service, existing_services, service_class

ARCS = ["robot.drive.min_turning_radius=0.5", "robot.drive.turns_in_place=false"]
ROBOTS = [load_robot("x80sv"), load_robot("jackal"), configured("x80sv", ARCS)]


def outcome(service, result, todo):
    """Checks what a handler produced; jobs wait in `todo`. Returns a request's reply."""
    iterator = iter(result or ())
    while True:
        try:
            produced = next(iterator)
        except StopIteration as end:
            return end.value
        if isinstance(produced, Publication):
            assert type(produced.message) is produced.topic.type
            assert not list(faults(produced.message))
        elif isinstance(produced, Job):
            todo.append(produced)
        else:
            assert isinstance(produced, Log)


@pytest.mark.parametrize("name", tuple(existing_services()))
def test_any_valid_messages_are_survived(name):
    kind = service_class(name)
    requested = [method for _, method in handlers(kind).requests.values()]

    @settings(max_examples=20, deadline=None, suppress_health_check=list(HealthCheck))
    @given(
        st.sampled_from(ROBOTS),
        st.lists(st.tuples(publications(kind), st.integers(-50, 400), st.none() | st.integers(-300, 120)), max_size=25),
    )
    def survives(robot, events):
        service = build_service(name, robot, robot.robot)
        todo = []
        now = 1_000_000_000
        for (method, message), wait, late in events:
            now = max(0, now + wait * 1_000_000)
            if message is not None and late is not None:  # as recent as messages are, so that it is not rejected
                message = replace(message, stamp=max(0, now + late * 1_000_000))
            service.now = now
            handler = getattr(service, method)
            reply = outcome(service, handler() if message is None else handler(message), todo)
            if method in requested:
                assert not list(faults(reply))
            for job in [todo.pop(0)] if todo else []:
                outcome(service, getattr(service, job.done)(job.function(*job.arguments)), todo)
            assert service.state()

    survives()
