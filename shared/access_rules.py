# SPDX-License-Identifier: Apache-2.0
"""Which member may do what on which key, as Zenoh's `access_control`: made from the registries of topics and requests.

Links of this computer (TCP on loopback) may do everything. A link over TLS may do what its certificate's member may:

| member | publishes | asks |
|---|---|---|
| viewer | nothing | latched values |
| operator | topics of the operator | also the requests of operators |
| admin | topics of the operator | also all other requests |
| service | its own topics | also all requests, and it answers its own |

At a site (docs/fleet.md) the rules are others: `site_access_control`.

Each member receives every topic. What is not allowed is dropped on arrival. Zenoh's certificate gives the name; a name
without a row, as of a revoked member, may do nothing.
"""

from typing import Any

from shared.crossing import CROSSING_REQUESTS, INWARD_KEYS, OUTWARD_KEYS, PRESENCE, SERVED_KEYS, SHARED_KEYS
from shared.requests import REQUESTS
from shared.roles import REQUEST_ROLES, TOOL_REQUEST_ROLES, Role, may
from shared.secure_folder import Member, MemberRole
from shared.topics import LATCHED_KEYS, SERVICES, TOPICS, key_of

PUT = ["put", "delete"]
ASK = ["query"]
RECEIVE = ["declare_subscriber"]
SERVE = ["reply", "declare_queryable"]
LIVELINESS = ["liveliness_token", "liveliness_query", "declare_liveliness_subscriber"]
EVERYTHING = [*PUT, *ASK, *RECEIVE, *SERVE, *LIVELINESS]
ANY_KEY = ["**", f"*/{PRESENCE}/**"]  # no wildcard matches a part that begins with @
OPERATOR = "operator"  # the publisher's name of a user's tool in the registry of topics
SIMULATED_WORLD = "sim/"
"""Begin of the keys by which a tool moves a simulated world. It runs on the simulator's computer."""

REVOKED = "revoked"

Rule = dict[str, Any]


def access_control(robot: str, members: list[Member]) -> dict[str, Any]:
    """Zenoh's `access_control` for a robot (first part of every key) and the members that are not revoked."""
    people = [member for member in members if member.role is not MemberRole.ROBOT]
    return _table(people, {kind: _rules_of(kind, robot) for kind in dict.fromkeys(map(member_kind, people))})


def site_access_control(members: list[Member]) -> dict[str, Any]:
    """Zenoh's `access_control` of a site's router. A robot speaks below its own name only, and hears only its orders.

    A person receives what crosses, and gives orders by the role. A service has no place there.
    """
    known = [member for member in members if member.role is not MemberRole.SERVICE]
    roles = [member.role for member in known if member.role is not MemberRole.ROBOT]
    rules = {str(role): _person_rules(Role(role)) for role in dict.fromkeys(roles)}
    robots = [member.name for member in known if member.role is MemberRole.ROBOT]
    return _table(known, rules | {f"robot {name}": _robot_rules(name) for name in dict.fromkeys(robots)})


def _table(members: list[Member], rules_of: dict[str, list[Rule]]) -> dict[str, Any]:
    """The rules of this computer, of each kind of member, and of those that are revoked."""
    rules: list[Rule] = [_rule("local", ["ingress", "egress"], EVERYTHING, ANY_KEY)]
    subjects: list[dict[str, Any]] = [{"id": "local", "link_protocols": ["tcp"]}]
    policies: list[dict[str, Any]] = [{"subjects": ["local"], "rules": ["local"]}]
    for kind, given in rules_of.items():
        names = [member.common_name for member in members if member_kind(member) == kind and not member.revoked]
        if not names:
            continue  # no name would mean: everybody
        rules += given
        subjects.append({"id": kind, "cert_common_names": names, "link_protocols": ["tls"]})
        policies.append({"subjects": [kind], "rules": [rule["id"] for rule in given]})
    if revoked := [member.common_name for member in members if member.revoked]:  # a rule, so that the log has the name
        rules.append({**_rule(REVOKED, ["ingress", "egress"], EVERYTHING, ANY_KEY), "permission": "deny"})
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
    """The role of a person, the name of a service, or `robot NAME`: what decides about access."""
    if member.role is MemberRole.ROBOT:
        return f"robot {member.name}"
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


def _robot_rules(name: str) -> list[Rule]:
    """What a robot may do at a site."""

    def on(keys: tuple[str, ...]) -> list[str]:
        return [f"{name}/{key}" for key in keys]

    kind, token, asked = f"robot {name}", [f"{name}/{PRESENCE}/**"], tuple(dict.fromkeys((*OUTWARD_KEYS, *SERVED_KEYS)))
    return [
        _rule(f"{kind} publishes", ["ingress"], PUT, on(OUTWARD_KEYS)),
        _rule(f"{kind} answers", ["ingress"], SERVE, on(SERVED_KEYS)),
        _rule(f"{kind} is asked", ["egress"], [*ASK, *RECEIVE], [*on(asked), *(f"*/{key}" for key in asked)]),
        _rule(f"{kind} is heard", ["egress"], RECEIVE, [f"{name}/**", "**"]),
        _rule(f"{kind} hears orders", ["ingress"], RECEIVE, on(INWARD_KEYS)),
        _rule(f"{kind} hears other robots", ["ingress"], RECEIVE, [f"*/{key}" for key in SHARED_KEYS]),
        _rule(f"{kind} gets what they say", ["egress"], PUT, [f"*/{key}" for key in SHARED_KEYS]),
        _rule(f"{kind} gets orders", ["egress"], PUT, on(INWARD_KEYS)),
        _rule(f"{kind} is present", ["ingress"], LIVELINESS, token),
        _rule(f"{kind} sees its name", ["egress"], LIVELINESS, token),
    ]


def _person_rules(role: Role) -> list[Rule]:
    """What a person may do at a site: of every robot."""
    roles = REQUEST_ROLES | TOOL_REQUEST_ROLES
    requests = [f"*/{row.key}" for row in CROSSING_REQUESTS if may(role, roles[row.key])]
    shown, latched = [f"*/{key}" for key in OUTWARD_KEYS], [f"*/{key}" for key in SERVED_KEYS if key in LATCHED_KEYS]
    orders = [f"*/{key}" for key in INWARD_KEYS if may(role, Role.OPERATOR)]
    rules = [
        _rule(f"{role} receives", ["egress"], [*PUT, *SERVE, *RECEIVE], [*shown, *requests, *orders]),
        _rule(f"{role} subscribes", ["ingress"], RECEIVE, shown),
        _rule(f"{role} asks", ["ingress"], ASK, [*latched, *requests]),
        _rule(f"{role} orders", ["ingress"], PUT, orders),
        _rule(f"{role} looks for robots", ["ingress"], LIVELINESS[1:], [f"*/{PRESENCE}/**"]),
        _rule(f"{role} sees robots", ["egress"], LIVELINESS[:1], [f"*/{PRESENCE}/**"]),
    ]
    return [rule for rule in rules if rule["key_exprs"]]


def _rule(name: str, flows: list[str], messages: list[str], keys: list[str]) -> Rule:
    return {"id": name, "permission": "allow", "flows": flows, "messages": messages, "key_exprs": keys}
