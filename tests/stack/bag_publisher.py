# SPDX-License-Identifier: Apache-2.0
"""A ROS 2 node that plays a bag onto rmw_zenoh's keys: PORT BAG TOPIC... It uses rosbags and Zenoh, nothing of zenav.

It publishes one message for each line of its input. It answers with the topic and with ns of the message's header, or
with "end". /tf_static is latched, and is published first. Of one moment odometry is published before the scan.
"""

import json
import struct
import sys
from hashlib import md5
from pathlib import Path

import zenoh
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from zenoh.ext import CacheConfig, declare_advanced_publisher

STORE = get_typestore(Stores.ROS2_JAZZY)
STATIC = "/tf_static"


class Node:
    """One session with the router, and its publishers."""

    def __init__(self, port: str) -> None:
        config = zenoh.Config()
        config.insert_json5("mode", json.dumps("client"))
        config.insert_json5("connect/endpoints", json.dumps([f"tcp/127.0.0.1:{port}"]))
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("timestamping/enabled", "true")
        self._session = zenoh.open(config)
        self._zid = str(self._session.info.zid())
        self._publishers: dict[str, tuple] = {}
        self._tokens: list = []
        self._n = 0

    def publish(self, topic: str, type_: str, data: bytes, stamp: int) -> None:
        if topic not in self._publishers:
            self._publishers[topic] = self._publisher(topic, type_)
        publisher, gid = self._publishers[topic]
        self._n += 1
        publisher.put(data, attachment=struct.pack("<qqB16s", self._n, stamp, 16, gid))

    def _publisher(self, topic: str, type_: str) -> tuple:
        package, _, name = type_.split("/")
        dds, type_hash = f"{package}::msg::dds_::{name}_", STORE.hash_rihs01(type_)
        key = f"0/{topic.strip('/')}/{dds}/{type_hash}"
        durability, mangled = (1 if topic == STATIC else 2), topic.replace("/", "%")
        qos = f"1:{durability}:1,10:,:,:,,"
        token = f"@ros2_lv/0/{self._zid}/0/{len(self._tokens) + 1}/MP/%/%/bag/{mangled}/{dds}/{type_hash}/{qos}"
        self._tokens.append(self._session.liveliness().declare_token(token))
        gid = md5(token.encode(), usedforsecurity=False).digest()
        if topic == STATIC:
            latched = declare_advanced_publisher(
                self._session, key, cache=CacheConfig(max_samples=1), publisher_detection=True
            )
            return latched, gid
        return self._session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK), gid


def stamp_of(message: object) -> int:
    header = message.transforms[0].header if hasattr(message, "transforms") else message.header
    return header.stamp.sec * 10**9 + header.stamp.nanosec


def main() -> None:
    port, bag, *topics = sys.argv[1:]
    node = Node(port)
    with AnyReader([Path(bag)], default_typestore=STORE) as reader:
        chosen = [connection for connection in reader.connections if connection.topic in topics]
        rows = [(c.topic, c.msgtype, at, bytes(raw)) for c, at, raw in reader.messages(connections=chosen)]
    rows.sort(key=lambda row: (row[0] != STATIC, row[2], row[0] == "/scan"))
    for topic, type_, _, raw in rows:
        if not sys.stdin.readline():
            return
        stamp = stamp_of(STORE.deserialize_cdr(raw, type_))
        node.publish(topic, type_, raw, stamp)
        sys.stdout.write(f"{topic} {stamp}\n")
        sys.stdout.flush()
    sys.stdin.readline()
    sys.stdout.write("end\n")
    sys.stdout.flush()


main()
