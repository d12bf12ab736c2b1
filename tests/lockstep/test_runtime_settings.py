# SPDX-License-Identifier: Apache-2.0
"""Settings that change while the robot drives: the next command and the next plan obey, and a replay repeats it."""

import numpy as np
import pytest

from shared import requests
from shared.codec import encode
from shared.recording import CONFIG, Recording, Writer, about, sink
from shared.requests import SetSettings
from shared.runners.lockstep import Lockstep
from shared.runners.replay import replay
from tests.lockstep.stack import LockstepStack
from tests.replay.record import ReferenceRun
from zenav.replay.report import service_builder
from zenav.replay.reprocess import replay_file
from zenav.stack.hardware import Hardware

pytestmark = pytest.mark.timeout(600)  # with an empty cache the kernels are compiled here

SPEED = "robot.drive.max_speed"
TAKERS = "local_ctrl", "planner", "guard", "navigator"
CORNER = """
start: {x: 1.0, y: 1.0}
walls:
  - {points: [[0, 0], [8, 0], [8, 6], [0, 6]], closed: true}
boxes:
  - {x: 3.5, y: 0.85, size: [0.6, 1.7]}
"""
"""A box from the wall over the straight line from the start to the goal: the plan leads around its end."""


def put(lockstep: Lockstep, service: str, name: str, text: str) -> None:
    reply = lockstep.ask(requests.SET, SetSettings(lockstep.now, (name,), (text,), False), service)
    assert reply.accepted, reply.detail


def test_a_lower_top_speed_is_obeyed_from_the_next_command_on_and_a_reset_ends_it(tmp_path):
    stack = LockstepStack(tmp_path)
    drive = stack.file.robot.drive
    commands = []
    stack.lockstep.watch("cmd/vel", lambda command: commands.append((command.stamp, command.v)))
    stack.go(8.0)
    stack.drives(0.75)
    changed = stack.now
    for service in ("local_ctrl", "guard"):
        put(stack.lockstep, service, SPEED, "0.3")
    stack.lockstep.run(2.0)
    after = [(stamp, v) for stamp, v in commands if stamp > changed]
    before, previous = next((stamp, v) for stamp, v in reversed(commands) if stamp <= changed)
    for stamp, v in after:  # each command brakes, as fast as the robot may, until the limit
        braked = previous - drive.max_braking * (stamp - before) * 1e-9
        assert v <= max(0.3, braked) + 1e-6, (stamp - changed, v)
        before, previous = stamp, v
    assert min(v for _, v in after[-10:]) > 0.2  # it drives on
    assert stack.truth.v < 0.35
    for service in ("local_ctrl", "guard"):
        put(stack.lockstep, service, SPEED, "")
    stack.drives(0.6)


def test_a_clearance_weight_changes_the_plan_at_once(tmp_path):
    stack = LockstepStack(tmp_path, CORNER)
    plans = []
    stack.lockstep.watch("plan", lambda plan: plans.append((plan.stamp, least_distance(plan))))
    stack.go(5.5)
    stack.until(lambda: plans, 3.0)
    found = []
    for weight in ("0", "50"):
        changed = stack.now
        put(stack.lockstep, "planner", "planner.cost.clearance_weight", weight)
        stack.lockstep.run(0.1)
        stamp, distance = plans[-1]
        assert stamp >= changed
        found.append(distance)
    assert found[1] > found[0] + 0.1


def least_distance(plan) -> float:
    """m from the path to the middle of the box's end, in `map`, whose origin is the robot's start."""
    return float(np.hypot(plan.xs - 2.5, plan.ys - 0.7).min())


def test_a_drive_with_changed_settings_and_a_restart_replays_to_the_byte(tmp_path):
    written, path = [], tmp_path / "run.mcap"
    run = ReferenceRun(written.append, "room", "x80sv", Hardware.MESSAGES)
    run.go(3.2, 0.6)
    run.lockstep.run(1.5)
    put(run.lockstep, "planner", "planner.cost.clearance_weight", "12")
    for service in ("local_ctrl", "guard"):
        put(run.lockstep, service, SPEED, "0.35")
    put(run.lockstep, "local_ctrl", "local_ctrl.mppi.critics.obstacle", "2")
    put(run.lockstep, "navigator", "navigator.leg.progress_time", "8")
    run.lockstep.run(1.0)
    run.restart("local_ctrl", after=0.3)
    run.lockstep.run(1.5)
    assert run.lockstep.service("local_ctrl").limits.v_max == 0.35
    run.lockstep.flush()
    with Writer(path, about(run.file.robot.name), {CONFIG: run.file.text.encode()}) as writer:
        for sent in written:
            sink(writer)(sent)
    report = replay_file(path, list(TAKERS), None, service_builder(run.file), lambda done, of: None, {})
    assert report.notes == []
    assert all(t.n_different == t.n_lacking == t.n_new == 0 for t in report.topics)
    counts = {topic.key: topic.n_equal for topic in report.topics}
    assert counts["cmd/vel"] > 80
    assert counts["settings/planner"] == counts["settings/guard"] == 1
    assert counts["settings/local_ctrl"] == 3  # set twice, and published again after the restart


def test_a_recording_that_began_after_a_change_is_replayed_with_the_changed_settings(tmp_path):
    began, before, after, path = [], [], [], tmp_path / "late.mcap"
    run = ReferenceRun(lambda sent: (after if began else before).append(sent), "room", "x80sv", Hardware.MESSAGES)
    put(run.lockstep, "planner", "planner.cost.clearance_weight", "12")
    run.lockstep.run(1.5)
    began.append(True)
    latched = [sent for sent in run.lockstep.latched.values() if sent.key in ("map", "pose", "settings/planner")]
    run.go(3.2, 0.6)
    run.lockstep.run(1.5)
    run.lockstep.flush()
    with Writer(path, about(run.file.robot.name), {CONFIG: run.file.text.encode()}) as writer:
        for sent in latched:
            payload = encode(sent.message, sent.envelope)
            at, sequence = sent.envelope.sent, sent.envelope.sequence
            writer.write(sent.key, sent.topic.type, payload, after[0].envelope.sent, at, sequence, latched=True)
        for sent in after:
            sink(writer)(sent)
    services = []
    build = service_builder(run.file)
    replay(Recording(path), ["planner", "guard"], lambda name: services.append(build(name)) or services[-1])
    assert [service.run_time for service in services] == [{"planner.cost.clearance_weight": "12"}, {}]
