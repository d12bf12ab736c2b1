# SPDX-License-Identifier: Apache-2.0
"""The two formats in which ROS 2 goes over Zenoh: rmw_zenoh's, and that of zenoh-bridge-ros2dds for nodes on DDS."""

from typing import NamedTuple, Protocol

from services.ros2 import rmw_names
from services.ros2.rmw_names import Durability, Endpoint, Entity, Qos, Reliability, RosName, RosNode, topic_key

SECTION = "§"  # in the place of / inside one part of a token of the DDS bridge
TWIST_BYTES = 52  # of a geometry_msgs/Twist in CDR; a TwistStamped is longer


class Attachment(NamedTuple):
    """What comes with a message or request: its number, the 16 bytes of its sender, ns on its clock when it was sent.

    The DDS bridge has none of them: 0, no bytes, None. It sends what several nodes publish in one stream, so they count
    as one node that drives.
    """

    sequence: int
    gid: bytes
    sent: int | None


class RosFormat(Protocol):
    """Keys, tokens and attachments. zid: of our Zenoh session.  number: of an endpoint in our node."""

    def node_tokens(self, zid: str) -> tuple[str, ...]:
        """The tokens of our node."""

    def endpoint_token(self, zid: str, number: int, entity: Entity, topic: RosName, qos: Qos) -> str:
        """The token of a publisher, subscription or service; empty where it needs none."""

    def tokens_key(self) -> str:
        """The key of all tokens of others."""

    def endpoint_of(self, token: str) -> Endpoint | None:
        """The endpoint of a token; None for other tokens."""

    def key(self, topic: RosName) -> str:
        """The key of a topic's messages, or of a service's requests."""

    def listening_key(self, name: str) -> str:
        """The key under which messages of a name come, of any type."""

    def type_of(self, key: str, topics: tuple[RosName, ...], n_bytes: int) -> str:
        """The type of a message of n bytes among those of a name; empty for another type or hash."""

    def attachment(self, sequence: int, stamp: int, gid: bytes) -> bytes | None:
        """The attachment of a message or reply. stamp: ns on the wall clock."""

    def attachment_of(self, data: bytes | None) -> Attachment | None:
        """What an attachment says; None where it does not fit the format."""


class RmwZenohFormat:
    """The format of rmw_zenoh (rmw_names.py)."""

    def __init__(self, domain: int, namespace: str, node: str) -> None:
        self._domain, self._place = domain, (namespace or "/", node)

    def _node(self, zid: str) -> RosNode:
        return RosNode(self._domain, zid, *self._place)

    def node_tokens(self, zid: str) -> tuple[str, ...]:
        return (self._node(zid).token(),)

    def endpoint_token(self, zid: str, number: int, entity: Entity, topic: RosName, qos: Qos) -> str:
        return self._node(zid).endpoint_token(number, entity, topic, qos)

    def tokens_key(self) -> str:
        return rmw_names.tokens_key(self._domain)

    def endpoint_of(self, token: str) -> Endpoint | None:
        return rmw_names.endpoint_of(token)

    def key(self, topic: RosName) -> str:
        return topic_key(self._domain, topic)

    def listening_key(self, name: str) -> str:
        return f"{self._domain}/{name.strip('/')}/*/*"

    def type_of(self, key: str, topics: tuple[RosName, ...], n_bytes: int) -> str:
        return next((topic.type for topic in topics if self.key(topic) == key), "")

    def attachment(self, sequence: int, stamp: int, gid: bytes) -> bytes | None:
        return rmw_names.attachment(sequence, stamp, gid)

    def attachment_of(self, data: bytes | None) -> Attachment | None:
        found = rmw_names.attachment_of(data) if data is not None else None
        return None if found is None else Attachment(found[0], found[2], found[1])


class DdsBridgeFormat:
    """The format of zenoh-bridge-ros2dds: the key is the name, and there is no attachment.

    Source: eclipse-zenoh/zenoh-plugin-ros2dds, liveliness_mgt.rs (commit ef5b9530), route_subscriber.rs (ebdb1e0b) and
    route_service_cli.rs (f26cec3b). The numbers of the quality of service are Cyclone DDS's.
    """

    def node_tokens(self, zid: str) -> tuple[str, ...]:
        return (f"@/{zid}/@ros2_lv",)

    def endpoint_token(self, zid: str, number: int, entity: Entity, topic: RosName, qos: Qos) -> str:
        action, is_part, part = topic.name.partition("/_action/")
        kind, name, type_ = str(entity), topic.name, topic.type
        if is_part:  # one token for all of an action
            if part != "send_goal":
                return ""
            kind, name, type_ = "AS", action, topic.type.removesuffix("_SendGoal")
        parts = [_escaped(self.key(RosName(name, type_, ""))), _escaped(type_)]
        if entity in (Entity.PUBLISHER, Entity.SUBSCRIPTION):
            parts.append(_qos_text(topic, qos))
        return "/".join(("@", zid, "@ros2_lv", kind, *parts))

    def tokens_key(self) -> str:
        return "@/*/@ros2_lv/**"

    def endpoint_of(self, token: str) -> Endpoint | None:
        parts = token.split("/")
        if len(parts) != 7 or parts[2] != "@ros2_lv" or parts[3] not in (Entity.PUBLISHER, Entity.SUBSCRIPTION):
            return None
        key, type_, qos = (part.replace(SECTION, "/") for part in parts[4:])
        fields = qos.split(":")
        if len(fields) < 4:
            return None
        durability = Durability.TRANSIENT_LOCAL if fields[2] == "1" else Durability.VOLATILE
        reliability = Reliability.BEST_EFFORT if fields[1] == "0" else Reliability.RELIABLE
        bridge = f"the bridge {parts[1]}"
        return Endpoint(Entity(parts[3]), bridge, RosName(f"/{key}", type_, ""), Qos(reliability, durability))

    def key(self, topic: RosName) -> str:
        return topic.name.strip("/")

    def listening_key(self, name: str) -> str:
        return name.strip("/")

    def type_of(self, key: str, topics: tuple[RosName, ...], n_bytes: int) -> str:
        """The key has no type. A Twist has its fixed length, a TwistStamped is longer."""
        if len(topics) == 1:
            return topics[0].type
        return next(topic.type for topic in topics if topic.type.endswith("Stamped") == (n_bytes != TWIST_BYTES))

    def attachment(self, sequence: int, stamp: int, gid: bytes) -> bytes | None:
        return None

    def attachment_of(self, data: bytes | None) -> Attachment | None:
        return Attachment(0, b"", None)


def _escaped(name: str) -> str:
    return name.replace("/", SECTION)


def _qos_text(topic: RosName, qos: Qos) -> str:
    """Keyless, reliability, durability, history and depth, user data: as Cyclone DDS has them."""
    reliability = int(qos.reliability is Reliability.RELIABLE)
    return f":{reliability}:{int(qos.is_latched)}:0,{qos.depth}:typehash={topic.hash};"
