# SPDX-License-Identifier: Apache-2.0
"""A robot that is only messages: a map of any size, and poses, odometry and scans of a drive in a circle."""

import math
import threading
import time

import numpy as np
import zenoh

from shared import topics
from shared.codec import Envelope, encode
from shared.geometry import Pose2
from shared.messages import TILE_CELLS, LaserScan, Localization, MapUpdate, Odometry, PoseEstimate
from shared.runners.client import Client
from shared.topics import Publication, key_of

SUBSCRIBES_S = 2.0  # that a new reader has before the map is published
PART = 900  # tiles of one message, which has 4 MiB at most
RESOLUTION = 0.05  # m/cell
ROOM_CELLS, DOOR_CELLS = 96, 20
SPECKS = 0.02  # share of cells with a random value
ODOMETRY_HZ = 50
ODOMETRY_A_SCAN, ODOMETRY_A_MAP = 5, 25  # messages of odometry for each scan, and each change of the map
CHANGED_TILES = 9  # as the mapper draws around the robot
RADIUS_M, SPEED, BEAMS = 2.0, 0.5, 720


class PublishedRobot:
    """Publishes on a thread of its own while its `with` block runs. tiles: of the map, each way."""

    def __init__(self, client: Client, tiles: int) -> None:
        self._client, self._map = client, building(tiles)
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._sequences: dict[str, int] = {}
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> "PublishedRobot":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()
        for publisher in self._publishers.values():
            publisher.undeclare()  # type: ignore[no-untyped-call]  # zenoh's own

    def _run(self) -> None:
        self._ended.wait(SUBSCRIBES_S)
        n = len(self._map.rows)
        for first in range(0, n, PART):
            self._publish_tiles(first, first + PART)
        tick, began = 0, time.monotonic()
        while not self._ended.wait(max(0.0, began + tick / ODOMETRY_HZ - time.monotonic())):
            self._publish_state(tick)
            if tick % ODOMETRY_A_MAP == 0:
                self._publish_tiles(n // 2, n // 2 + CHANGED_TILES)
            tick += 1

    def _publish_state(self, tick: int) -> None:
        now, w = self._client.now(), SPEED / RADIUS_M
        angle = w * tick / ODOMETRY_HZ
        pose = Pose2(RADIUS_M * math.cos(angle), RADIUS_M * math.sin(angle), angle + math.pi / 2)
        covariance = np.diag((1e-4, 1e-4, 1e-4)).ravel()
        self._publish(topics.ODOM(Odometry(now, pose, SPEED, w, covariance)), "odometry")
        if tick % ODOMETRY_A_SCAN == 0:
            still = Pose2(0.0, 0.0, 0.0)
            estimate = PoseEstimate(
                stamp=now,
                map_from_base=pose,
                map_from_odom=still,
                covariance=covariance,
                quality=1.0,
                state=Localization.GOOD,
            )
            self._publish(topics.POSE(estimate), "mapper")
            angles = np.linspace(-math.pi, math.pi, BEAMS, endpoint=False)
            ranges = (3.0 + np.sin(5 * angles)).astype(np.float32)
            scan = LaserScan(
                stamp=now,
                angle_min=-math.pi,
                angle_increment=2 * math.pi / BEAMS,
                scan_time=0.1,
                range_min=0.1,
                range_max=10.0,
                ranges=ranges,
            )
            self._publish(topics.SCAN(scan), "lidar_driver")

    def _publish_tiles(self, first: int, end: int) -> None:
        places = np.arange(len(self._map.rows))
        self._publish(topics.MAP(self._map.only((first <= places) & (places < end))), "mapper")

    def _publish(self, publication: Publication, publisher: str) -> None:
        client, key = self._client, key_of(publication.topic, publisher)
        if key not in self._publishers:
            self._publishers[key] = client.session.declare_publisher(
                f"{client.robot}/{key}", congestion_control=zenoh.CongestionControl.BLOCK
            )
        sequence = self._sequences[key] = self._sequences.get(key, -1) + 1
        envelope = Envelope(publisher, client.session_name, sequence, client.now())
        self._publishers[key].put(encode(publication.message, envelope))


def building(tiles: int) -> MapUpdate:
    """A map of tiles x tiles around the origin: rooms with doors, and specks of every value."""
    n = tiles * TILE_CELLS
    cells = np.zeros((n, n), np.int8)
    walls = np.arange(0, n, ROOM_CELLS)
    cells[walls, :] = cells[:, walls] = 100
    is_door = np.abs(np.arange(n) % ROOM_CELLS - ROOM_CELLS // 2) < DOOR_CELLS // 2
    cells[is_door] = np.where(cells[is_door] == 100, 0, cells[is_door])
    cells[:, is_door] = np.where(cells[:, is_door] == 100, 0, cells[:, is_door])
    random = np.random.default_rng(0)
    row, column = random.integers(0, n, (2, round(n * n * SPECKS)))
    cells[row, column] = random.integers(-1, 101, len(row))
    tiled = cells.reshape(tiles, TILE_CELLS, tiles, TILE_CELLS).swapaxes(1, 2).reshape(tiles * tiles, -1)
    rows, columns = np.divmod(np.arange(tiles * tiles, dtype=np.int32), np.int32(tiles))
    return MapUpdate(
        stamp=1,
        map_id=1,
        version=1,
        resolution=RESOLUTION,
        rows=rows - tiles // 2,
        columns=columns - tiles // 2,
        cells=np.ascontiguousarray(tiled),
    )
