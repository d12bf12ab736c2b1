# SPDX-License-Identifier: Apache-2.0
"""Access rules follow the registries: the guard alone publishes commands, and no rule is for all."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.access_rules import (
    REVOKED,
    access_control,
    askable_keys,
    publishable_keys,
    served_keys,
    site_access_control,
)
from shared.crossing import INWARD_KEYS, OUTWARD_KEYS, SERVED_KEYS
from shared.requests import REQUESTS
from shared.roles import REQUEST_ROLES, TOOL_REQUEST_ROLES, Role
from shared.secure_folder import Member, MemberRole
from shared.topics import KEYS, SERVICES, TOPICS

members = st.builds(
    lambda role, service, n, revoked: Member(
        service if role is MemberRole.SERVICE else f"p{n}", role, f"m{n}", "2030-01-01", revoked
    ),
    st.sampled_from(MemberRole),
    st.sampled_from(SERVICES),
    st.integers(0, 10**6),
    st.booleans(),
)


def test_each_request_has_a_role():
    assert {row.key for row in REQUESTS} == set(REQUEST_ROLES) | set(TOOL_REQUEST_ROLES)
    assert not set(REQUEST_ROLES) & set(TOOL_REQUEST_ROLES)


def test_persons_publish_what_tools_publish_and_viewers_nothing():
    assert publishable_keys(Role.VIEWER) == []
    assert (
        set(publishable_keys(Role.OPERATOR))
        == set(publishable_keys(Role.ADMIN))
        == {"cmd/teleop", "estop", "explore/others"}
    )


@pytest.mark.parametrize("name", SERVICES)
def test_a_service_publishes_its_own_rows_alone(name):
    allowed = {f"{topic.key}/{name}" if topic.by == "*" else topic.key for topic in TOPICS if name in topic.publishers}
    assert set(publishable_keys(name)) == allowed
    assert ("cmd/vel" in allowed) == (name == "guard")
    assert set(served_keys(name)) >= {row.key_of(name) for row in REQUESTS if name in row.services}


def test_roles_ask_more_and_more():
    asked = [set(askable_keys(role)) for role in Role]
    assert asked[0] < asked[1] < asked[2]
    assert asked[2] >= {key for row in REQUESTS for key in row.keys}
    assert {"pose", "map"} <= asked[0]


@given(st.lists(members, max_size=12, unique_by=lambda member: member.common_name))
def test_rules_give_each_name_the_rules_of_its_role_alone_and_no_rule_holds_for_everybody(rows):
    control = access_control("x80", rows)
    assert control["default_permission"] == "deny"
    subjects = {subject["id"]: subject for subject in control["subjects"]}
    rules = {rule["id"]: rule for rule in control["rules"]}
    assert len(rules) == len(control["rules"]), "a name of two rules"
    for name, subject in subjects.items():
        assert subject["link_protocols"] == (["tcp"] if name == "local" else ["tls"])
        assert name == "local" or subject["cert_common_names"], "a subject without names would be everybody"
    for row in rows:
        given_to = [
            name
            for policy in control["policies"]
            for name in policy["subjects"]
            if row.common_name in subjects[name].get("cert_common_names", [])
        ]
        kind = row.name if row.role is MemberRole.SERVICE else str(row.role)
        assert given_to == ([] if row.role is MemberRole.ROBOT else [REVOKED if row.revoked else kind])
    for rule in rules.values():
        if rule["id"] not in ("local", REVOKED):
            assert all(key.startswith("x80/") for key in rule["key_exprs"])
            if "put" in rule["messages"] and "ingress" in rule["flows"]:
                assert {key.removeprefix("x80/") for key in rule["key_exprs"]} <= set(KEYS)


@given(st.lists(members, max_size=12, unique_by=lambda member: member.common_name))
def test_at_a_site_a_robot_speaks_below_its_own_name_alone_and_only_what_crosses(rows):
    control = site_access_control(rows)
    rules = {rule["id"]: rule for rule in control["rules"]}
    assert len(rules) == len(control["rules"]), "a name of two rules"
    kinds = {name: subject for subject in control["subjects"] for name in subject.get("cert_common_names", [])}
    of_subject = {name: policy["rules"] for policy in control["policies"] for name in policy["subjects"]}
    for row in rows:
        if row.role is MemberRole.SERVICE:
            assert row.common_name not in kinds, "a service of a robot has no place at the site"
            continue
        kind = kinds[row.common_name]["id"]
        assert kind == (REVOKED if row.revoked else f"robot {row.name}" if row.role is MemberRole.ROBOT else row.role)
        given = [rules[name] for name in of_subject[kind]]
        sends = [rule for rule in given if "ingress" in rule["flows"] and set(rule["messages"]) & {"put", "reply"}]
        sent = {key for rule in sends for key in rule["key_exprs"]}
        if row.role is MemberRole.ROBOT and not row.revoked:
            assert sent == {f"{row.name}/{key}" for key in (*OUTWARD_KEYS, *SERVED_KEYS)}
        elif not row.revoked:
            assert sent == {f"*/{key}" for key in INWARD_KEYS if row.role is not MemberRole.VIEWER}


def test_commands_by_hand_do_not_cross_and_of_what_comes_in_stop_is_all():
    assert INWARD_KEYS == ("estop",)
    assert not {"cmd/teleop", "cmd/nav", "cmd/vel", "request/override", "request/set/guard"} & {
        *OUTWARD_KEYS, *INWARD_KEYS, *SERVED_KEYS
    }  # fmt: skip
