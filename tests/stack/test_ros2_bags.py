# SPDX-License-Identifier: Apache-2.0
"""A robot's bag, played by a foreign node onto rmw_zenoh's keys, makes the map that `zenav slam` makes of the file.

The player is in a process of its own and knows nothing of zenav. Its messages pass a router, the bridge's shell and
core, odometry and the mapper. It waits for each message to be mapped, so the result does not depend on the load.
"""

import os
import subprocess
import sys
from collections import defaultdict, deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgpack
import numpy as np
import pytest
from scipy.spatial import cKDTree

from services.mapper.config import MapperConfig
from services.odometry.dead_reckoning import DeadReckoningConfig
from services.odometry.service import OdometryService
from services.ros2 import bridge_device
from services.ros2.service import Ros2Service
from shared import topics
from shared.config import Robot
from shared.messages import PortState, SerialData
from shared.ros_map import read_ros_map
from shared.service import Log, Out, Service
from tests.unit.services.ros2.network import Bridge, free_port, router
from zenav.convert.content import Choice
from zenav.convert.log_robot import robot_of_log
from zenav.convert.records import LoggedScan
from zenav.convert.source import read_log
from zenav.maps.atomic_folder import replace_together
from zenav.maps.saved_map import map_files
from zenav.slam.offline_slam import MAP_EVERY, OfflineRun, mapper_time, offline_slam
from zenav.stack.launch import free_stack

BAGS = Path(os.environ.get("ZENAV_DATA", "")) / "bags"  # noqa: TID251  # where the machine keeps its logs
BAG = BAGS / "belgioioso_sqlite"
PLAYER = Path(__file__).with_name("bag_publisher.py")
CELL_M = 0.05
NETWORK_NS = 8_000_000  # the longest delay of a message

pytestmark = pytest.mark.skipif(not BAGS.is_dir(), reason="ZENAV_DATA has no bags: they are not on this machine")


@pytest.fixture(autouse=True)
def unlimited(monkeypatch):
    """A bag is played as fast as it is mapped: the bridge takes more messages a second than of a robot."""
    monkeypatch.setattr(bridge_device, "_interval", lambda name: 0.0)


@pytest.fixture(scope="module")
def mapped(tmp_path_factory) -> tuple[Path, dict]:
    """The map's folder and the report of `zenav slam` over the bag's file."""
    folder = tmp_path_factory.mktemp("bag") / "file"
    return folder, offline_slam(BAG, folder)


@contextmanager
def bridge_of(port: int, odometry: str) -> Iterator[Bridge]:
    """The bridge's shell, joined to the router. Its stack is empty."""
    with free_stack() as claim:
        bridge = Bridge(port, claim.where, drives=True, odometry=odometry)
        bridge.device.start()
        try:
            bridge.wait_open()
            yield bridge
        finally:
            bridge.device.close()


class BagRun:
    """The services that a driven robot's messages pass, on the bag's clock."""

    def __init__(self, bridge: Bridge, robot: Robot, first: int) -> None:
        self._bridge, self._first = bridge, first
        self.ros2, self.odometry = Ros2Service(bridge.config, robot), OdometryService(DeadReckoningConfig(), robot)
        self.ros2.name = "ros2"
        self.run = OfflineRun(MapperConfig(), robot)
        self.logs: list[str] = []
        self.n_scans, self._n_events = 0, 0
        self._waiting: defaultdict[str, deque[dict]] = defaultdict(deque)  # messages by topic
        self._delays = np.random.default_rng(1)
        self._step(
            self.ros2,
            mapper_time(first, first),
            self.ros2.port_state(PortState(mapper_time(first, first), "ros", True, "")),
        )

    def take(self, topic: str, stamp: int) -> None:
        """The next message of a topic, which its header says is of `stamp` ns. It comes some ms later."""
        event = self._bridge.wait(lambda: self._messages(topic)).popleft()
        now = mapper_time(self._first, stamp) + int(self._delays.integers(NETWORK_NS))
        self.run.mapper.now = now
        self.run.add(self.run.mapper.release())
        self._step(self.ros2, now, self.ros2.receive(SerialData(now, "ros", _packed(event))))
        self.run.run_jobs()
        if self.n_scans and self.n_scans % MAP_EVERY == 0:
            self.run.add(self.run.mapper.publish_map())

    def _messages(self, topic: str) -> deque[dict]:
        for event in self._bridge.events[self._n_events :]:
            self._n_events += 1
            if event["event"] == "message":
                self._waiting[event["name"]].append(event)
        return self._waiting[topic]

    def _step(self, service: Service, now: int, out: Out) -> None:
        service.now = self.ros2.now = self.odometry.now = max(now, service.now)
        self.run.mapper.now = max(now, self.run.mapper.now)
        for item in out:
            if isinstance(item, Log):
                self.logs.append(item.text)
            elif item.topic is topics.BASE_MOTION:
                self._step(self.odometry, now, self.odometry.base_odometry(item.message))
            elif item.topic is topics.ODOM:
                self.run.add(self.run.mapper.odometry(item.message))
            elif item.topic is topics.SCAN:
                self.n_scans += 1
                self.run.add(self.run.mapper.scan(item.message))


def _packed(event: dict) -> bytes:
    return bytes(msgpack.packb(event))


@contextmanager
def playing(port: int, bag: Path, *chosen: str) -> Iterator[Iterator[tuple[str, int]]]:
    """Topic and stamp of each message, published when it is asked for."""
    command = (sys.executable, str(PLAYER), str(port), str(bag), *chosen)
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:

        def rows() -> Iterator[tuple[str, int]]:
            while True:
                process.stdin.write("next\n")
                process.stdin.flush()
                line = process.stdout.readline().split()
                if line == ["end"]:
                    return
                yield line[0], int(line[1])

        try:
            yield rows()
        finally:
            process.kill()


def walls(folder: Path) -> np.ndarray:
    """(n, 2) m, the centres of a map's occupied cells."""
    cells, resolution, x0, y0 = read_ros_map(folder / "map.yaml")
    rows, columns = np.nonzero(cells == 100)
    return np.column_stack((x0 + (columns + 0.5) * resolution, y0 + (rows + 0.5) * resolution))


@pytest.mark.parametrize("odometry", ["odom", "tf"])
def test_a_bag_over_ros_makes_the_map_of_its_file(odometry, mapped, tmp_path):
    file_map, report = mapped
    records = read_log(BAG, Choice()).records
    robot = robot_of_log([record for record in records if isinstance(record, LoggedScan)])
    port = free_port()
    with router(port), bridge_of(port, odometry) as bridge:
        played = BagRun(bridge, robot, min(record.stamp for record in records))
        with playing(port, BAG, "/tf_static", "/scan", f"/{odometry}") as rows:
            for topic, stamp in rows:
                played.take(topic, stamp)
    run = played.run
    run.finish()
    assert played.logs == ["ROS 2: connected, in domain 0"]
    assert len(run.estimates) == report["scans_placed"] == report["scans"]
    poses = np.array([(e.map_from_base.x, e.map_from_base.y, e.map_from_base.yaw) for e in run.corrected_estimates()])
    replace_together(tmp_path / "ros", map_files(run.saved(), poses))
    mine, theirs = walls(tmp_path / "ros"), walls(file_map)
    for these, others in ((mine, theirs), (theirs, mine)):
        away = cKDTree(others).query(these)[0]
        assert away.mean() < 0.01  # m
        assert (away < 1.5 * CELL_M).mean() > 0.98
