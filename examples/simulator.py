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

PORT = 17400 + 40 * int(os.environ.get("ZENAV_STACK", "0"))  # of the service sim; the others have the next ones
RADIUS, WIDTH, COUNTS, WRAP = 0.085, 0.283, 756 / (2 * math.pi), 32768  # m, m, encoder counts a rad, counts
BEAMS, STEP, SWEEP = 450, -0.013962634015954637, 0.09978  # beams, rad, s
LASER_X, LASER_YAW = 0.13, -math.pi / 2  # m, rad in base
BOXES = np.array([[-1.5, -2, 4.5, -2], [-1.5, 2, 4.5, 2], [-1.5, -2, -1.5, 2], [4.5, -2, 4.5, 2], [1.6, 0.4, 2.2, 1.0]])
OTHERS = [f"tcp/127.0.0.1:{PORT + i}" for i in range(1, 14)]
ZENOH = {
    "listen": {"endpoints": [f"tcp/127.0.0.1:{PORT}"]}, "scouting": {"multicast": {"enabled": False}},
    "connect": {"endpoints": OTHERS, "exit_on_failure": False, "timeout_ms": -1, "retry": {"period_max_ms": 1000}},
    "transport": {"shared_memory": {"enabled": False}},
}  # fmt: skip


def array(values):
    """float32 with one axis: 16 bytes of header, then the values."""
    return struct.pack("<BBxxIII", 0, 1, len(values), 0, 0) + np.asarray(values, "<f4").tobytes()


def moved(pose, wheels, seconds):
    """The pose x, y, yaw (m, m, rad) after both wheels turned with these rad/s; seconds: a number, or (n,)."""
    x, y, yaw = pose
    v, w = RADIUS * wheels.mean(), RADIUS * (wheels[1] - wheels[0]) / WIDTH
    middle = yaw + w * seconds / 2
    return x + v * np.cos(middle) * seconds, y + v * np.sin(middle) * seconds, yaw + w * seconds


def ranges(x, y, angle):
    """Ranges (n,) in m of beams from x, y (n,) along angle (n,) to the nearest of BOXES (x0, y0, x1, y1; m)."""
    start, slope = np.stack((x, y)), np.stack((np.cos(angle), np.sin(angle)))
    with np.errstate(divide="ignore", invalid="ignore"):
        enter, leave = (BOXES[:, :2, None] - start) / slope, (BOXES[:, 2:, None] - start) / slope
    near, far = np.minimum(enter, leave).max(axis=1), np.maximum(enter, leave).min(axis=1)
    return np.where((near <= far + 1e-9) & (near > 0), near, np.inf).min(axis=0)


with zenoh.open(zenoh.Config.from_json5(json.dumps(ZENOH))) as session:
    started, sequences, motors = f"{time.time_ns():x}", {}, {"left": 0.0, "right": 0.0, "stamp": 0}
    commands = session.declare_subscriber("x80/hardware/motors",
        lambda sample: motors.update(msgpack.unpackb(sample.payload.to_bytes())))  # fmt: skip
    wheels, angles, pose, noise = np.zeros(2), np.zeros(2), (0.0, 0.0, 0.0), np.random.default_rng(0)  # rad/s, rad

    def put(key, **fields):
        sequences[key] = sequences.get(key, -1) + 1
        session.put(f"x80/{key}", msgpack.packb({"@": ["sim", started, sequences[key], time.time_ns()], **fields}))

    then = due = time.time()
    while True:
        time.sleep(max(0.0, due - time.time()))
        now, due = time.time(), due + 0.02
        is_fresh = now - motors["stamp"] / 1e9 < 0.2  # without commands the board stops
        wanted = np.array([-motors["left"], motors["right"]]) / COUNTS * is_fresh  # the left encoder counts down
        wheels += (wanted - wheels) * min(1.0, (now - then) / 0.08)
        angles += wheels * (now - then)
        pose, then = moved(pose, wheels, now - then), now
        left, right = (int(count) for count in np.rint(angles * (-COUNTS, COUNTS)) % WRAP)
        put("hardware/board", stamp=round(now * 1e9), left_counts=left, right_counts=right,
            left_speed=-wheels[0] * COUNTS, right_speed=wheels[1] * COUNTS, ultrasonic=array([math.nan] * 3),
            infrared=array([math.nan] * 7), battery=7.6, currents=array([0.3, 0.3]))  # fmt: skip
        if sequences["hardware/board"] % 5 == 0:
            x, y, yaw = moved(pose, wheels, np.linspace(-SWEEP, 0, BEAMS))  # at each beam
            at = x + LASER_X * np.cos(yaw), y + LASER_X * np.sin(yaw), yaw + LASER_YAW + STEP * np.arange(BEAMS)
            put("scan", stamp=round((now - SWEEP) * 1e9), angle_min=0.0, angle_increment=STEP, scan_time=SWEEP,
                range_min=0.05, range_max=12.0, ranges=array(ranges(*at) + noise.normal(0, 0.01, BEAMS)))  # fmt: skip
