# SPDX-License-Identifier: Apache-2.0
"""Settings that change at run time: any requests leave the last valid state, and never a part of a change."""

import json
from itertools import chain

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shared import requests, topics
from shared.config import UserError, load_robot
from shared.messages import RuntimeSettings
from shared.requests import SetSettings
from shared.runners.host import Host
from shared.runners.lockstep import Lockstep
from shared.service import Service
from shared.settings import (
    BY_NAME,
    RUNTIME_SETTINGS,
    Configuration,
    field_at,
    present_values,
    reconfigured,
    settings_of,
    value_at,
)
from tests.strategies import faults
from zenav.stack.config_report import section_models
from zenav.stack.service_loader import build_service, existing_services

FILE = load_robot("x80sv")
SERVICES = tuple(existing_services())
SOME = (
    *("robot.drive.max_speed", "robot.drive.max_turn_rate", "local_ctrl.max_speed", "local_ctrl.costmap.scan"),
    *("local_ctrl.mppi.critics.progress", "planner.cost.unknown", "guard.stops.scan_age", "local_ctrl.no_such"),
)
VALID = ["0.3", "0.1", "0", "true", "false", "costly", ""]
TEXTS = st.sampled_from([*VALID, "-1", "1e9", "[1]", "2001-99-99", "{", "null"])
CHANGES = st.dictionaries(st.sampled_from(SOME), TEXTS, min_size=1, max_size=4)


def service_named(name: str) -> Service:
    return build_service(name, FILE, FILE.robot)


LOCAL_CTRL = service_named("local_ctrl")


def ask(lockstep: Lockstep, service: str, values: dict[str, str], check: bool = False):
    request = SetSettings(lockstep.now, tuple(values), tuple(values.values()), check)
    return lockstep.ask(requests.SET, request, service)


def test_every_row_is_a_setting_of_the_models_that_its_services_have():
    models = section_models()
    for row in RUNTIME_SETTINGS:
        assert field_at(models[row.path[0]], row.path[1:]).description, row.name
        assert row.path[0] in ("robot", *row.services), row.name
    assert len(BY_NAME) == len(RUNTIME_SETTINGS) >= 20


def test_no_setting_of_the_guard_changes_and_only_limits_of_the_robot():
    assert {row.path[0] for row in settings_of("guard")} == {"robot"}
    assert all(row.is_limit for row in RUNTIME_SETTINGS if row.path[0] == "robot")
    assert not any(
        word in row.name
        for row in RUNTIME_SETTINGS
        for word in ("braking", ".ages.", "watchdog", ".port.", "lidar_driver")
    )


@pytest.mark.parametrize("name", SERVICES)
def test_a_configuration_without_changes_is_the_one_of_the_start(name):
    started = service_named(name).started
    assert reconfigured(name, started, {}) == started


@pytest.mark.parametrize("name", [name for name in SERVICES if settings_of(name)])
def test_every_setting_of_a_service_takes_its_own_value_and_reports_it(name):
    lockstep = Lockstep({name: service_named(name)})
    held = ask(lockstep, name, {})
    assert held.accepted
    assert held.values == held.started
    again = ask(lockstep, name, dict(zip(held.names, held.values, strict=True)))
    assert again.accepted, again.detail
    assert [json.loads(text) for text in again.values] == [json.loads(text) for text in held.started]


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(CHANGES, st.booleans()), max_size=6))
def test_any_requests_leave_the_state_of_the_last_valid_one(sequence):
    lockstep = Lockstep({"local_ctrl": LOCAL_CTRL})
    service = lockstep.service("local_ctrl")
    list(service.settings_before_restart(RuntimeSettings(0, (), ())))  # as it was started
    expected: dict[str, str] = {}
    for changes, check in sequence:
        wanted = {name: text for name, text in (expected | changes).items() if text}
        try:
            for name in changes:
                assert "local_ctrl" in BY_NAME[name].services
            valid = reconfigured("local_ctrl", service.started, wanted)
        except (UserError, KeyError, AssertionError):
            valid = None
        reply = ask(lockstep, "local_ctrl", changes, check)
        assert reply.accepted == (valid is not None)
        assert not list(faults(reply))
        assert bool(reply.detail) == bool(reply.hint) == (valid is None)
        if valid is not None and not check:
            expected = wanted
        assert Configuration(service.config, service.robot) == reconfigured("local_ctrl", service.started, expected)
        assert service.limits.v_max <= service.started.robot.drive.max_speed
        present = present_values("local_ctrl", Configuration(service.config, service.robot))
        assert dict(zip(reply.names, reply.values, strict=True)) == present


@pytest.mark.parametrize(
    ("name", "text", "fault", "hint"),
    [
        ("planner.cost.clearance_weight", "101", "less than or equal to 100 (it is 101)", "m of detour"),
        ("planner.cost.clearance_weight", "far", "valid number", "m of detour"),
        ("planner.cost.clearance_weight", "[4]", "is no value", "one number"),
        ("planner.cost.clearance_wait", "4", "clearance_wait is not a setting", "planner.cost.clearance_weight"),
        ("planner.cost.unknown", "never", "'costly'", "unknown space"),
        ("guard.stops.scan_age", "1", "guard.stops.scan_age is not a setting", "known"),
    ],
)
def test_a_refusal_says_what_is_wrong_with_a_hint_and_nothing_changes(name, text, fault, hint):
    lockstep = Lockstep({"planner": service_named("planner")})
    reply = ask(lockstep, "planner", {"planner.cost.narrow_weight": "3", name: text})
    assert not reply.accepted
    assert fault in reply.detail
    assert hint in reply.hint
    assert "\n" not in reply.detail + reply.hint
    assert reply.values == reply.started
    assert not lockstep.latched


def test_a_limit_is_lowered_and_raised_again_to_its_first_value_but_never_above():
    lockstep = Lockstep({"guard": service_named("guard")})
    for text in ("0.3", "0.5", "0.8"):
        assert ask(lockstep, "guard", {"robot.drive.max_speed": text}).accepted
    reply = ask(lockstep, "guard", {"robot.drive.max_speed": "0.81"})
    assert "may only be lowered" in reply.detail
    assert lockstep.service("guard").robot.drive.max_speed == 0.8


def test_a_combination_that_the_models_refuse_is_refused():
    lockstep = Lockstep({"recorder": service_named("recorder")})
    reply = ask(lockstep, "recorder", {"recorder.split_size": "600", "recorder.budget": "1000"}, check=True)
    assert "split_size is over half of the budget" in reply.detail
    assert ask(lockstep, "recorder", {"recorder.split_size": "400", "recorder.budget": "1000"}, check=True).accepted


def test_a_restarted_service_holds_its_settings_and_tells_them_and_others_do_not_take_them():
    lockstep = Lockstep({"planner": service_named("planner"), "guard": service_named("guard")})
    assert ask(lockstep, "planner", {"planner.cost.clearance_weight": "7"}).accepted
    lockstep.kill("planner")
    lockstep.kill("guard")
    lockstep.run(3600.0)
    for name in ("planner", "guard"):
        lockstep.start(name, service_named(name))
    lockstep.run(1.0)
    assert lockstep.service("planner").config.cost.clearance_weight == 7
    assert lockstep.service("guard").run_time == {}
    assert lockstep.latched["settings/planner"].envelope.session == "planner-3"  # a life ends with `kill`, too
    assert ask(lockstep, "planner", {"planner.cost.clearance_weight": ""}).accepted
    assert lockstep.latched["settings/planner"].message.names == ()
    assert lockstep.service("planner").config == lockstep.service("planner").started.config


def test_settings_that_a_changed_file_forbids_are_dropped_with_a_warning_after_a_restart():
    host = Host(service_named("guard"), "guard", "x")
    before = RuntimeSettings(0, ("robot.drive.max_speed",), ("0.9",))
    effects = list(chain(host.service.settings_before_restart(before)))
    assert "may only be lowered" in effects[0].text
    assert effects[1].message == RuntimeSettings(0, (), ())
    assert host.service.robot == FILE.robot


def test_values_are_told_as_yaml_that_reads_back():
    started = service_named("navigator").started
    for name, text in present_values("navigator", started).items():
        assert json.loads(text) == value_at(started, BY_NAME[name])
    assert topics.SETTINGS.latched
