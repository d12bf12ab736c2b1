# SPDX-License-Identifier: Apache-2.0
"""Names and bytes of rmw_zenoh: keys of topics and services, liveliness tokens, quality of service, attachments.

Source: ros2/rmw_zenoh, rmw_zenoh_cpp/src/detail/liveliness_utils.cpp (commit 3411fdec), qos.cpp and
attachment_helpers.cpp (commit 534747dc). The formats are in docs/ros2.md.
"""

import struct
from dataclasses import dataclass
from enum import IntEnum, StrEnum

SPACE = "@ros2_lv"
SLASH = "%"  # in the place of / inside one part of a token
ATTACHMENT = struct.Struct("<qqB16s")
"""Sequence number, ns on the wall clock, length of the gid, gid."""
GID_BYTES = 16


class Reliability(IntEnum):
    """rmw_qos_reliability_policy_e."""

    RELIABLE = 1
    BEST_EFFORT = 2


class Durability(IntEnum):
    """rmw_qos_durability_policy_e."""

    TRANSIENT_LOCAL = 1
    VOLATILE = 2


class Entity(StrEnum):
    """Kind of a token."""

    NODE = "NN"
    PUBLISHER = "MP"
    SUBSCRIPTION = "MS"
    SERVICE = "SS"
    CLIENT = "SC"


@dataclass(frozen=True, slots=True)
class Qos:
    """Quality of service with the history keep-last. The defaults are rmw_zenoh's, which its tokens leave out."""

    reliability: Reliability = Reliability.RELIABLE
    durability: Durability = Durability.VOLATILE
    depth: int = 42

    @property
    def text(self) -> str:
        """The last part of a token. Reliability, durability and history are written out."""
        return f"{self.reliability:d}:{self.durability:d}:1,{self.depth}:,:,:,,"

    @property
    def is_latched(self) -> bool:
        """Whether a late subscriber gets the last message."""
        return self.durability is Durability.TRANSIENT_LOCAL


@dataclass(frozen=True, slots=True)
class RosName:
    """A topic or service. name: with a leading slash.  type: as sensor_msgs/msg/LaserScan.  hash: RIHS01."""

    name: str
    type: str
    hash: str


@dataclass(frozen=True, slots=True)
class RosNode:
    """Our node. zid: of the Zenoh session.  namespace: with a leading slash; "/" is none."""

    domain: int
    zid: str
    namespace: str
    name: str

    def token(self) -> str:
        """The token of the node."""
        return f"{SPACE}/{self.domain}/{self.zid}/0/0/{Entity.NODE}/{self._place}"

    def endpoint_token(self, number: int, entity: Entity, topic: RosName, qos: Qos) -> str:
        """The token of a publisher, subscription, service or client. number: its own in this node."""
        parts = (mangled(topic.name), dds_type(topic.type), topic.hash, qos.text)
        return f"{SPACE}/{self.domain}/{self.zid}/0/{number}/{entity}/{self._place}/{'/'.join(parts)}"

    @property
    def _place(self) -> str:
        return f"{SLASH}/{mangled(self.namespace)}/{self.name}"


@dataclass(frozen=True, slots=True)
class Endpoint:
    """What a token of another node says. type: as sensor_msgs/msg/LaserScan; node: with its namespace."""

    entity: Entity
    node: str
    topic: RosName
    qos: Qos


def topic_key(domain: int, topic: RosName) -> str:
    """The key of a topic's messages, or of a service's requests."""
    return f"{domain}/{topic.name.strip('/')}/{dds_type(topic.type)}/{topic.hash}"


def tokens_key(domain: int) -> str:
    """The key of every token of a domain."""
    return f"{SPACE}/{domain}/**"


def dds_type(type_: str) -> str:
    """`sensor_msgs::msg::dds_::LaserScan_` of `sensor_msgs/msg/LaserScan`."""
    package, kind, name = type_.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def ros_type(dds: str) -> str:
    """`sensor_msgs/msg/LaserScan` of `sensor_msgs::msg::dds_::LaserScan_`."""
    return dds.replace("::dds_::", "::").replace("::", "/").removesuffix("_")


def mangled(name: str) -> str:
    """A name as one part of a token."""
    return name.replace("/", SLASH)


def endpoint_of(token: str) -> Endpoint | None:
    """The endpoint of a token; None for a node's, and for what is no token. Rolling has one more part at the end."""
    parts = token.split("/")
    if len(parts) < 13 or parts[0] != SPACE or parts[5] not in tuple(Entity):
        return None
    namespace, node, name, dds, type_hash, qos_text = parts[7:13]
    qos = qos_of(qos_text)
    if qos is None:
        return None
    place = f"{namespace.replace(SLASH, '/').rstrip('/')}/{node}"
    return Endpoint(Entity(parts[5]), place, RosName(name.replace(SLASH, "/"), ros_type(dds), type_hash), qos)


def qos_of(text: str) -> Qos | None:
    """The quality of service of a token's last part; an empty field is rmw_zenoh's default. None where it is none."""
    parts = text.split(":")
    history = parts[2].split(",") if len(parts) >= 3 else []
    try:
        return Qos(
            Reliability(int(parts[0])) if parts[0] else Reliability.RELIABLE,
            Durability(int(parts[1])) if parts[1] else Durability.VOLATILE,
            int(history[1]) if history[1] else Qos().depth,
        )
    except (IndexError, ValueError):
        return None


def attachment(sequence: int, stamp: int, gid: bytes) -> bytes:
    """The attachment of a message, request or reply. stamp: ns on the wall clock.  gid: 16 bytes."""
    return ATTACHMENT.pack(sequence, stamp, GID_BYTES, gid)


def attachment_of(data: bytes) -> tuple[int, int, bytes] | None:
    """Sequence number, ns and gid of an attachment; None where it is none."""
    if len(data) != ATTACHMENT.size:
        return None
    sequence, stamp, length, gid = ATTACHMENT.unpack(data)
    return (sequence, stamp, gid) if length == GID_BYTES else None


def mismatch_text(theirs: Endpoint, ours: RosName, qos: Qos) -> str:
    """Why an endpoint of another node and ours of the same name do not match; empty where they do.

    rmw_zenoh delivers whatever the reliability. A type or hash is part of the key, so another one gets nothing.
    """
    what = "publishes" if theirs.entity is Entity.PUBLISHER else "subscribes to"
    start = f"{theirs.node} {what} {theirs.topic.name}"
    if theirs.topic.type != ours.type:
        return f"{start} as {theirs.topic.type}, here it is {ours.type}: neither gets a message"
    if theirs.topic.hash not in ("", ours.hash):
        return f"{start} with another definition of {ours.type}: is it of the same distribution? see ros2.distro"
    if theirs.entity is Entity.SUBSCRIPTION and theirs.qos.is_latched and not qos.is_latched:
        return f"{start} as transient local, here it is volatile: it gets no message from before its subscription"
    return ""
