# SPDX-License-Identifier: Apache-2.0
"""The whole stack as processes, treated badly: it says what is wrong, goes on, and leaves nothing behind."""

import os
import signal
import socket
import subprocess
import sys
import threading
from itertools import takewhile
from pathlib import Path

import msgpack
import numpy as np
import psutil
import pytest

from services.mapper.maps.map_file import unpack_map
from shared import topics
from shared.codec import decode
from shared.config import UserError
from shared.messages import NavState
from shared.requests import REQUESTS, GiveMap
from shared.runners.stop_confirmation import confirm_stop
from shared.topics import SERVICES, TOPICS
from tests.stack.processes import ALL, ROBOT, StackProcesses, running, wait
from zenav.client.map_transfer import fetch_map
from zenav.stack.launch import ROOT, Launcher, free_stack, service_command


def near_truth(stack: StackProcesses) -> bool:
    """The mapper's pose is the true one, within what a moving robot's delay explains."""
    pose, truth = stack.client.latest(topics.POSE), stack.client.latest(topics.TRUTH)
    if pose is None or truth is None:
        return False
    return (truth.start @ pose.map_from_base).distance(truth.world_from_base) < 0.3


def stands(stack: StackProcesses) -> bool:
    truth = stack.client.latest(topics.TRUTH)
    return truth is not None and abs(truth.v) < 0.01 and abs(truth.w) < 0.02


def graph_nodes(stack: StackProcesses) -> set[int]:
    """Names of the nodes of the mapper's pose graph."""
    saved = unpack_map(fetch_map(stack.client, threading.Event().wait), "the mapper's map")
    return set(saved.graph.nodes.tolist())


def checkpoint_nodes(folder: Path) -> set[int]:
    """Names of the nodes in the mapper's checkpoint below a folder."""
    paths = list(folder.rglob("mapper-checkpoint.msgpack"))
    if not paths:
        return set()
    parts = [decode(GiveMap, payload)[0].data for _, payload in msgpack.unpackb(paths[0].read_bytes())]
    return set(unpack_map(b"".join(parts), "the checkpoint").graph.nodes.tolist())


def test_services_that_start_in_another_order_drive_to_a_goal(tmp_path):
    with running(tmp_path, order=1) as stack:
        stack.until(stack.reached(stack.go()))
        assert near_truth(stack)
        assert stack.client.latest(topics.TRUTH).n_contacts == 0
        pids = [stack.pid(name) for name in ALL]
    assert not any(psutil.pid_exists(pid) for pid in pids)


def test_a_killed_mapper_comes_back_with_its_map_and_the_robot_goes_on(tmp_path):
    with running(tmp_path) as stack:
        stack.until(stack.reached(stack.go()))
        before, tiles = stack.pid("mapper"), stack.client.latched_value(topics.MAP)
        nodes = graph_nodes(stack)
        stack.until(lambda: checkpoint_nodes(tmp_path) >= nodes)
        os.kill(before, signal.SIGKILL)
        stack.until(lambda: stack.healths["mapper"].pid not in (before, 0) and stack.launcher.children["mapper"].heard)
        assert any(name == "mapper" and "killed by SIGKILL" in line for name, line in stack.told)
        stack.until(
            lambda: (m := stack.client.latched_value(topics.MAP)) is not None and len(m.rows) >= len(tiles.rows)
        )
        stack.until(lambda: near_truth(stack) and stack.client.age(topics.POSE) < 1)
        task = stack.go(stack.client.latest(topics.POSE).map_from_base)
        stack.until(stack.reached(task))
        assert graph_nodes(stack) >= nodes


def test_a_killed_navigator_comes_back_with_its_task_and_the_robot_gets_there(tmp_path):
    with running(tmp_path, world="corridor") as stack:
        pose = stack.client.latest(topics.POSE).map_from_base
        goal = type(pose)(pose.x + 4.0, pose.y, pose.yaw)
        task = stack.go(goal)
        stack.until(lambda: not stands(stack))
        before = stack.pid("navigator")
        os.kill(before, signal.SIGKILL)
        stack.until(
            lambda: stack.healths["navigator"].pid not in (before, 0) and stack.launcher.children["navigator"].heard
        )
        stack.until(stack.reached(task), 60)
        assert stack.client.latest(topics.TRUTH).n_contacts == 0
        reached = stack.client.latest(topics.POSE).map_from_base
        assert reached.distance(goal) < 0.3


def test_a_stop_while_the_navigator_is_dead_wins_and_after_its_release_nothing_moves(tmp_path):
    with running(tmp_path, world="corridor") as stack:
        pose = stack.client.latest(topics.POSE).map_from_base
        task = stack.go(type(pose)(pose.x + 4.0, pose.y, pose.yaw))
        stack.until(lambda: not stands(stack))
        os.kill(stack.pid("navigator"), signal.SIGKILL)
        confirm_stop(stack.client, True, "test")
        confirm_stop(stack.client, False, "test")
        stack.until(lambda: stack.client.latest(topics.NAV_STATUS).state is NavState.CANCELED)
        nav = stack.client.latest(topics.NAV_STATUS)
        assert (nav.task_id, nav.reason) == (task, "estop_released")
        stack.until(lambda: stands(stack))
        driven = stack.client.latest(topics.TRUTH).distance
        wait(3.0)
        assert stack.client.latest(topics.TRUTH).distance - driven < 0.01


def test_a_stopped_local_ctrl_is_noticed_the_robot_stands_and_it_is_replaced(tmp_path):
    with running(tmp_path, world="corridor") as stack:
        goal = stack.client.latest(topics.POSE).map_from_base
        task = stack.go(type(goal)(goal.x + 2.0, goal.y, goal.yaw))
        stack.until(lambda: not stands(stack))
        before = stack.pid("local_ctrl")
        os.kill(before, signal.SIGSTOP)
        stack.until(lambda: stack.client.latest(topics.GUARD).reason == "command_old")
        stack.until(lambda: stands(stack))
        stack.until(lambda: stack.launcher.children["local_ctrl"].n_restarts == 1)
        assert not psutil.pid_exists(before)
        assert any(name == "local_ctrl" and "hung" in line for name, line in stack.told)
        stack.until(stack.reached(task), 60)


def test_random_bytes_on_every_key_are_counted_and_change_nothing(tmp_path):
    with running(tmp_path) as stack:
        pids = {name: stack.pid(name) for name in ALL}
        rng = np.random.default_rng(0)
        keys = [t.key if t.by != "*" else f"{t.key}/{name}" for t in TOPICS for name in SERVICES]
        for key in [*dict.fromkeys(keys), "nonsense", "cmd/nonsense"]:
            for size in (0, 1, 20, 3000):
                stack.client.session.put(f"{ROBOT.name}/{key}", rng.bytes(size))
        for request in (row for row in REQUESTS if row.by == "*" or row.by in ALL):
            key = f"{ROBOT.name}/{request.key_of('mapper')}"
            replies = list(stack.client.session.get(key, payload=rng.bytes(40), timeout=20.0))
            refusals = [decode(request.reply, reply.ok.payload.to_bytes())[0] for reply in replies]
            assert [(refusal.accepted, refusal.reason) for refusal in refusals] == [(False, "bad_request")]
        stack.until(lambda: all(stack.healths[name].bad_messages > 0 for name in ALL))
        stack.until(stack.reached(stack.go()))
        assert {name: stack.pid(name) for name in ALL} == pids
        assert not any(child.n_restarts for child in stack.launcher.children.values())


def test_a_taken_port_is_told_by_the_service_that_needs_it(tmp_path):
    with free_stack() as claim, socket.socket() as holder:
        port = claim.where.port("odometry")
        holder.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # what an earlier stack left in TIME_WAIT is free
        holder.bind(("127.0.0.1", port))
        holder.listen()
        command = service_command("odometry", "x80sv", str(claim.where.domain), [])
        with Launcher({"odometry": command}, tmp_path) as launcher:
            launcher.start_all()
            with pytest.raises(UserError, match=f"port {port} is taken"):
                step_for(launcher, 60)


def step_for(launcher: Launcher, seconds: int) -> None:
    for _ in range(10 * seconds):
        launcher.step()
        wait(0.1)


def test_ctrl_c_ends_zenav_up_and_every_process(tmp_path):
    with free_stack() as claim:
        domain = claim.where.domain
    environment = dict(os.environ, PYTHONPATH=str(ROOT))  # noqa: TID251
    command = [sys.executable, "-m", "zenav", "up", "--world", "room", "--stack", str(domain)]
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True, env=environment) as up:
        killer = threading.Timer(90, up.kill)
        killer.start()
        for line in up.stderr:
            if "every service runs" in line:
                break
        pids = [child.pid for child in psutil.Process(up.pid).children(recursive=True)]
        assert len(pids) >= len(ALL)
        up.send_signal(signal.SIGINT)
        rest = up.stderr.read()
        killer.cancel()
    assert up.returncode == 0, rest
    assert not any(psutil.pid_exists(pid) for pid in pids)


def test_systemd_hears_that_the_stack_is_ready_lives_and_ends(tmp_path):
    with free_stack() as claim:
        domain = claim.where.domain
    address = tmp_path / "notify"
    environment = {
        **os.environ,  # noqa: TID251
        "PYTHONPATH": str(ROOT), "NOTIFY_SOCKET": str(address), "WATCHDOG_USEC": "1000000",
    }  # fmt: skip
    only = "sim,base_driver,odometry"
    command = [sys.executable, "-m", "zenav", "up", "--world", "room", "--only", only, "--stack", str(domain)]
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(address))
        systemd.settimeout(90)
        with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True, env=environment) as up:
            killer = threading.Timer(110, up.kill)
            killer.start()
            words = iter(lambda: systemd.recv(4096).decode(), "")
            before = list(takewhile(lambda word: word != "READY=1", words))
            assert set(before) <= {"WATCHDOG=1"}
            assert next(words).startswith("STATUS=3 services run")
            assert [next(words) for _ in range(4)] == ["WATCHDOG=1"] * 4
            up.send_signal(signal.SIGTERM)
            up.stderr.read()
            killer.cancel()
        systemd.settimeout(1)
        while (word := systemd.recv(4096).decode()) == "WATCHDOG=1":
            pass
    assert word == "STOPPING=1"
    assert up.returncode == 0
