# SPDX-License-Identifier: Apache-2.0
"""Which member may do what on which key, as Zenoh's `access_control`: made from the registries of topics and requests.

Links of this computer (TCP on loopback) may do everything. A link over TLS may do what its certificate's member may:

| member | publishes | asks |
|---|---|---|
| viewer | nothing | latched values |
| operator | topics of the operator | also the requests of operators |
| admin | topics of the operator | also all other requests |
| service | its own topics | also all requests, and it answers its own |

Each member receives every topic. What is not allowed is dropped on arrival. Zenoh's certificate gives the name; a name
without a row, as of a revoked member, may do nothing.
"""

from typing import Any

from shared.requests import REQUESTS
from shared.roles import REQUEST_ROLES, TOOL_REQUEST_ROLES, Role, may
from shared.secure_folder import Member, MemberRole
from shared.topics import LATCHED_KEYS, SERVICES, TOPICS, key_of

PUT = ["put", "delete"]
ASK = ["query"]
RECEIVE = ["declare_subscriber"]
SERVE = ["reply", "declare_queryable"]
EVERYTHING = [*PUT, *ASK, *RECEIVE, *SERVE, "liveliness_token", "liveliness_query", "declare_liveliness_subscriber"]
OPERATOR = "operator"  # the publisher's name of a user's tool in the registry of topics
SIMULATED_WORLD = "sim/"
"""Begin of the keys by which a tool moves a simulated world. It runs on the simulator's computer."""

REVOKED = "revoked"

Rule = dict[str, Any]


def access_control(robot: str, members: list[Member]) -> dict[str, Any]:
    """Zenoh's `access_control` for a robot (first part of every key) and the members that are not revoked."""
    valid = [member for member in members if not member.revoked]
    rules: list[Rule] = [_rule("local", ["ingress", "egress"], EVERYTHING, ["**"])]
    subjects: list[dict[str, Any]] = [{"id": "local", "link_protocols": ["tcp"]}]
    policies: list[dict[str, Any]] = [{"subjects": ["local"], "rules": ["local"]}]
    for kind in dict.fromkeys(member_kind(member) for member in valid):
        names = [member.common_name for member in valid if member_kind(member) == kind]  # none would mean: everybody
        given = _rules_of(kind, robot)
        rules += given
        subjects.append({"id": kind, "cert_common_names": names, "link_protocols": ["tls"]})
        policies.append({"subjects": [kind], "rules": [rule["id"] for rule in given]})
    if revoked := [member.common_name for member in members if member.revoked]:  # a rule, so that the log has the name
        rules.append({**_rule(REVOKED, ["ingress", "egress"], EVERYTHING, ["**"]), "permission": "deny"})
        subjects.append({"id": REVOKED, "cert_common_names": revoked, "link_protocols": ["tls"]})
        policies.append({"subjects": [REVOKED], "rules": [REVOKED]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def member_kind(member: Member) -> str:
    """The role of a person, or the name of a service: what decides about access."""
    return member.name if member.role is MemberRole.SERVICE else str(member.role)


def publishable_keys(kind: str) -> list[str]:
    """Keys without the robot's name that a person's role or a service may publish."""
    publisher = kind if kind in SERVICES else OPERATOR
    if kind == Role.VIEWER:
        return []
    keys = [key_of(topic, publisher) for topic in TOPICS if publisher in topic.publishers]
    return [key for key in keys if publisher != OPERATOR or not key.startswith(SIMULATED_WORLD)]


def askable_keys(kind: str) -> list[str]:
    """Keys without the robot's name that it may ask: the latched topics, and requests."""
    role = Role.ADMIN if kind in SERVICES else Role(kind)
    roles = REQUEST_ROLES | TOOL_REQUEST_ROLES
    return [*LATCHED_KEYS, *(key for row in REQUESTS if may(role, roles[row.key]) for key in row.keys)]


def served_keys(kind: str) -> list[str]:
    """Keys without the robot's name that it answers: its own latched topics, and of a service its requests.

    A tool serves the last STOP to late subscribers, as every publisher of a latched topic does.
    """
    own = set(publishable_keys(kind))
    latched = [key for topic in TOPICS if topic.latched and (key := key_of(topic, kind)) in own]
    return latched + [row.key_of(kind) for row in REQUESTS if kind in row.services]


def _rules_of(kind: str, robot: str) -> list[Rule]:
    def on(keys: list[str]) -> list[str]:
        return [f"{robot}/{key}" for key in keys]

    shown = [f"{robot}/**"]
    rules = [
        _rule(f"{kind} receives", ["egress"], [*PUT, *SERVE, *RECEIVE], shown),
        _rule(f"{kind} subscribes", ["ingress"], RECEIVE, shown),
        _rule(f"{kind} asks", ["ingress"], ASK, on(askable_keys(kind))),
        _rule(f"{kind} publishes", ["ingress"], PUT, on(publishable_keys(kind))),
        _rule(f"{kind} answers", ["ingress"], SERVE, on(served_keys(kind))),
        _rule(f"{kind} is asked", ["egress"], ASK, on(served_keys(kind))),
    ]
    return [rule for rule in rules if rule["key_exprs"]]


def _rule(name: str, flows: list[str], messages: list[str], keys: list[str]) -> Rule:
    return {"id": name, "permission": "allow", "flows": flows, "messages": messages, "key_exprs": keys}
