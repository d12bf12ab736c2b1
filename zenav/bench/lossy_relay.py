# SPDX-License-Identifier: Apache-2.0
"""A process that is a network between two TUN devices: it delays IP packets, and drops some.

`python -m zenav.bench.lossy_relay NAME NAME SEED` makes the devices and writes `ready`. Each line on stdin is JSON:
`delay` (s, each way), `loss` (share, each way), and gets the line `set`. It ends with its stdin. Packets of one way
keep their order, as they do on one link; a queue of MAX_PACKETS holds what is under way (Linux:
Documentation/networking/tuntap.rst).
"""

import fcntl
import json
import os
import select
import struct
import sys
import time
from collections import deque

import numpy as np

TUNSETIFF, IFF_TUN, IFF_NO_PI = 0x400454CA, 0x0001, 0x1000
MAX_BYTES = 2048  # of a packet; the devices' MTU is 1500
MAX_PACKETS = 1000  # under way, each way, as netem's limit


def opened_tun(name: str) -> int:
    """The file descriptor of a new TUN device. Raises OSError without the right to make one."""
    file = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(file, TUNSETIFF, struct.pack("16sH22x", name.encode(), IFF_TUN | IFF_NO_PI))
    return file


def main(first: str, second: str, seed: str) -> None:
    """Relays until stdin ends."""
    ends = opened_tun(first), opened_tun(second)
    other = {ends[0]: ends[1], ends[1]: ends[0]}
    under_way: dict[int, deque[tuple[float, bytes]]] = {end: deque() for end in ends}  # by where they go
    orders = sys.stdin.fileno()
    rng, delay, loss = np.random.default_rng(int(seed)), 0.0, 0.0
    _say("ready")
    while True:
        due = min((packets[0][0] for packets in under_way.values() if packets), default=float("inf"))
        wait = None if due == float("inf") else max(0.0, due - time.monotonic())
        readable, _, _ = select.select([*ends, orders], [], [], wait)
        now = time.monotonic()
        for end, packets in under_way.items():
            while packets and packets[0][0] <= now:
                _write(end, packets.popleft()[1])
        for end in readable:
            if end == orders:
                line = sys.stdin.readline()
                if not line:
                    return
                given = json.loads(line)
                delay, loss = given["delay"], given["loss"]
                _say("set")
            elif (packet := _read(end)) and rng.random() >= loss and len(under_way[other[end]]) < MAX_PACKETS:
                under_way[other[end]].append((now + delay, packet))


def _say(word: str) -> None:
    sys.stdout.write(f"{word}\n")
    sys.stdout.flush()


def _read(end: int) -> bytes:
    try:
        return os.read(end, MAX_BYTES)
    except OSError:
        return b""  # the device is not up


def _write(end: int, packet: bytes) -> None:
    try:
        os.write(end, packet)
    except OSError:
        return  # as a network does: the packet is lost


if __name__ == "__main__":
    main(*sys.argv[1:])
