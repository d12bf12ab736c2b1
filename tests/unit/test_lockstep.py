# SPDX-License-Identifier: Apache-2.0
"""The lockstep runner's laws, on two toy services."""

import pytest

from shared import topics
from shared.config import Robot, Section, load_robot
from shared.messages import EmergencyStop, GuardState, GuardStatus, Velocity, WheelState
from shared.runners.lockstep import START, Lockstep
from shared.service import Job, Out, Service, every, on

ROBOT = load_robot("x80sv").robot


class Ticker(Service):
    @every(hz=50)
    def tick(self) -> Out:
        yield topics.WHEELS(WheelState(self.now, 0, 0.1, 0.2, 0.0, 0.0))


class Counter(Service):
    def __init__(self, config: Section, robot: Robot) -> None:
        super().__init__(config, robot)
        self.seen: list[tuple[int, int]] = []
        self.jobs: list[int] = []

    @on(topics.WHEELS)
    def wheels(self, wheels: WheelState) -> Out:
        self.seen.append((wheels.stamp, self.now))
        if len(self.seen) == 1:
            yield Job(sum, ([1, 2],), done="added", takes=0.5)

    def added(self, total: int) -> Out:
        self.jobs.append(self.now)
        assert total == 3
        return ()


def stack() -> dict[str, Service]:
    return {"base_driver": Ticker(Section(), ROBOT), "odometry": Counter(Section(), ROBOT)}


def test_messages_arrive_after_their_topics_latency():
    lockstep = Lockstep(stack())
    lockstep.run(1.0)
    seen = lockstep.service("odometry").seen
    assert len(seen) == 50
    assert {now - stamp for stamp, now in seen} == {2_000_000}


def test_a_job_is_done_after_its_modelled_duration():
    lockstep = Lockstep(stack())
    lockstep.run(1.0)
    assert lockstep.service("odometry").jobs == [START + 2_000_000 + 500_000_000]


def test_a_killed_service_hears_and_says_nothing_and_its_successor_starts_from_the_start():
    lockstep = Lockstep(stack())
    lockstep.run(0.5)
    lockstep.kill("odometry")
    lockstep.run(0.2)
    lockstep.start("odometry", Counter(Section(), ROBOT))
    lockstep.run(0.1)
    assert len(lockstep.service("odometry").seen) == 4


def test_a_filter_loses_and_delays():
    lockstep = Lockstep(stack())
    lockstep.filters.append(lambda sent, to: None if sent.envelope.sequence % 2 else 0.1)
    lockstep.run(1.0)
    seen = lockstep.service("odometry").seen
    assert {now - stamp for stamp, now in seen} == {102_000_000}
    assert len(seen) == 23


def test_a_late_joiner_gets_the_latched_value():
    class Joiner(Service):
        def __init__(self) -> None:
            super().__init__(Section(), ROBOT)
            self.pressed: list[bool] = []

        @on(topics.ESTOP)
        def estop(self, estop) -> Out:  # type: ignore[no-untyped-def]
            self.pressed.append(estop.pressed)
            return ()

    lockstep = Lockstep({})
    lockstep.publish(topics.ESTOP(EmergencyStop(START, True, "test")))
    lockstep.run(1.0)
    lockstep.start("guard", Joiner())
    lockstep.run(0.1)
    assert lockstep.service("guard").pressed == [True]


def test_a_restarted_publisher_hears_first_and_at_once_what_it_had_latched_itself():
    class Stopping(Service):
        def __init__(self) -> None:
            super().__init__(Section(), ROBOT)
            self.heard: list[tuple[str, int]] = []

        @on(topics.GUARD)
        def itself(self, status: GuardStatus) -> Out:
            self.heard.append(("itself", self.now))
            return ()

        @every(hz=1)
        def tell(self) -> Out:
            self.heard.append(("tick", self.now))
            yield topics.GUARD(GuardStatus(self.now, GuardState.IDLE, "", "", "", 0.0))

    lockstep = Lockstep({"guard": Stopping()})
    lockstep.run(0.5)
    assert lockstep.service("guard").heard == [("tick", START)]
    lockstep.kill("guard")
    lockstep.start("guard", Stopping())
    lockstep.run(0.1)
    restarted = START + 500_000_000
    assert lockstep.service("guard").heard == [("itself", restarted), ("tick", restarted)]


def test_nobody_publishes_what_is_not_theirs():
    class Forger(Service):
        @every(hz=1)
        def tick(self) -> Out:
            yield topics.CMD_VEL(Velocity(self.now, 0.0, 0.0, ""))

    lockstep = Lockstep({"odometry": Forger(Section(), ROBOT)})
    with pytest.raises(TypeError, match="cmd/vel"):
        lockstep.run(1.0)


def test_two_runs_give_the_same_bytes():
    def run() -> list[bytes]:
        payloads: list[bytes] = []
        lockstep = Lockstep(stack(), record=lambda sent: payloads.append(sent.payload))
        lockstep.run(2.5)
        lockstep.flush()
        return payloads

    assert run() == run()


def test_what_is_not_above_its_session_s_last_sequence_is_rejected_and_counted():
    lockstep = Lockstep(stack())
    sequences = lockstep._hosts["base_driver"]._sequences
    lockstep.run(0.5)
    counter = lockstep.service("odometry")
    n_seen = len(counter.seen)
    lockstep.watch("base/wheels", lambda _: sequences.update({"base/wheels": 3}))
    lockstep.run(0.5)
    assert len(counter.seen) == n_seen + 2  # one was on its way, after one the count is set back
    assert counter.rejections.counts == {("base/wheels", "sequence"): 23}
    assert counter.rejections.stamp_problem("base/wheels", lockstep.now) == "wheels: the sequence goes back"
