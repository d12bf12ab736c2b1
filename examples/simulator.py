# SPDX-License-Identifier: Apache-2.0
"""A simulator of the X80SV in a room of 6 x 4 m: board and laser, by docs/wire.md, without zenav's code.

zenav up --external sim --no-browser      # in one terminal
python examples/simulator.py              # in another; ZENAV_STACK as for zenav
"""

import json
import math
import os
import struct
import time

import msgpack
import numpy as np
import zenoh

BASE = 17400 + 40 * int(os.environ.get("ZENAV_STACK", "0"))
PORTS = [f"tcp/127.0.0.1:{BASE + i}" for i in range(12)]
RADIUS, WIDTH, COUNTS, WRAP = 0.085, 0.283, 756 / (2 * math.pi), 32768  # m, m, encoder counts a rad, counts
BEAMS, FIRST, STEP, SWEEP = 450, 0.0, -0.013962634015954637, 0.09978  # beams, rad, rad, s
LASER_X, LASER_YAW = 0.13, -math.pi / 2  # in base
# walls, then a box: x0 y0 x1 y1, m
BOXES = np.array([[-1.5, -2, 4.5, -2], [-1.5, 2, 4.5, 2], [-1.5, -2, -1.5, 2], [4.5, -2, 4.5, 2], [1.6, 0.4, 2.2, 1.0]])


def array(values):
    """float32 with one axis: 16 bytes of header, then the values."""
    return struct.pack("<BBxxIII", 0, 1, len(values), 0, 0) + np.asarray(values, "<f4").tobytes()


def ranges(x, y, angle):
    """Ranges (n,) in m of beams from x, y (n,) along angle (n,) to the nearest box, by the slab method."""
    near, far = np.full((len(BOXES), len(x)), -np.inf), np.full((len(BOXES), len(x)), np.inf)
    for axis, (start, slope) in enumerate(((x, np.cos(angle)), (y, np.sin(angle)))):
        with np.errstate(divide="ignore", invalid="ignore"):
            enter, leave = (BOXES[:, axis, None] - start) / slope, (BOXES[:, axis + 2, None] - start) / slope
        near, far = np.maximum(near, np.minimum(enter, leave)), np.minimum(far, np.maximum(enter, leave))
    return np.where((near <= far + 1e-9) & (near > 0), near, np.inf).min(axis=0)


class Publisher:
    """Puts messages on a key, with their envelopes."""

    def __init__(self, session, key):
        self.publisher, self.sequence = session.declare_publisher(f"x80/{key}"), 0
        self.session = f"{time.time_ns():x}-{os.getpid():x}"

    def put(self, **fields):
        envelope = ["sim", self.session, self.sequence, time.time_ns()]
        self.publisher.put(msgpack.packb({"@": envelope, **fields}))
        self.sequence += 1


def body_moved(pose, wheels, seconds):
    """The pose x, y, yaw (m, m, rad) after both wheels turned with these rad/s."""
    x, y, yaw = pose
    v, w = RADIUS * wheels.mean(), RADIUS * (wheels[1] - wheels[0]) / WIDTH
    middle = yaw + w * seconds / 2
    return x + v * math.cos(middle) * seconds, y + v * math.sin(middle) * seconds, yaw + w * seconds


def opened():
    """A Zenoh session in the place of the service sim."""
    config = zenoh.Config()
    settings = {
        "listen/endpoints": PORTS[:1], "connect/endpoints": PORTS[1:], "connect/exit_on_failure": False,
        "connect/timeout_ms": -1, "scouting/multicast/enabled": False, "transport/shared_memory/enabled": False,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2},
    }  # fmt: skip
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def main():
    motors = {"left": 0.0, "right": 0.0, "stamp": 0}
    with opened() as session:
        take = session.declare_subscriber("x80/hardware/motors", zenoh.handlers.RingChannel(1))
        board, scan = Publisher(session, "hardware/board"), Publisher(session, "scan")
        noise, wheels, angles = np.random.default_rng(0), np.zeros(2), np.zeros(2)  # wheels left, right: rad/s; rad
        then = due = time.time()
        poses, n = [(then, 0.0, 0.0, 0.0)], 0  # s, m, m, rad: of the last 0.24 s
        while True:
            time.sleep(max(0.0, due - time.time()))
            now, due, n = time.time(), due + 0.02, n + 1
            while (sample := take.try_recv()) is not None:
                motors = msgpack.unpackb(sample.payload.to_bytes())
            is_fresh = now - motors["stamp"] / 1e9 < 0.2  # without commands the board stops
            wanted = np.array([-motors["left"], motors["right"]]) / COUNTS * is_fresh  # the left encoder counts down
            wheels += (wanted - wheels) * min(1.0, (now - then) / 0.08)
            angles += wheels * (now - then)
            poses = [*poses[-11:], (now, *body_moved(poses[-1][1:], wheels, now - then))]
            then = now
            left, right = (int(count) for count in np.rint(angles * (-COUNTS, COUNTS)) % WRAP)
            board.put(
                stamp=round(now * 1e9), left_counts=left, right_counts=right, left_speed=-wheels[0] * COUNTS,
                right_speed=wheels[1] * COUNTS, ultrasonic=array([math.nan] * 3), infrared=array([math.nan] * 7),
                battery=7.6, currents=array([0.3, 0.3]),
            )  # fmt: skip
            if n % 5 == 0:
                at = now - SWEEP + np.linspace(0, SWEEP, BEAMS)
                x, y, yaw = (np.interp(at, np.array(poses)[:, 0], column) for column in np.array(poses).T[1:])
                beam = FIRST + STEP * np.arange(BEAMS) + LASER_YAW + yaw
                measured = ranges(x + LASER_X * np.cos(yaw), y + LASER_X * np.sin(yaw), beam)
                scan.put(
                    stamp=round((now - SWEEP) * 1e9), angle_min=FIRST, angle_increment=STEP, scan_time=SWEEP,
                    range_min=0.05, range_max=12.0, ranges=array(measured + noise.normal(0, 0.01, BEAMS)),
                )  # fmt: skip


if __name__ == "__main__":
    main()
