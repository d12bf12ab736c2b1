# SPDX-License-Identifier: Apache-2.0
"""The navigator owns the zones: it publishes them, refuses goals in them, and restores them after a restart."""

import numpy as np
import pytest
from pydantic import ValidationError

from services.navigator.config import NavigatorConfig
from services.navigator.goal_check import refused_pose
from services.navigator.service import NavigatorService
from shared import reasons, topics
from shared.geometry import Pose2
from shared.grid import OccupancyGrid
from shared.messages import MAX_ZONES, NavState, Path, Zones
from shared.polygon import contains
from shared.requests import Navigate, SetZones
from shared.zones import NamedZoneConfig, ZoneConfig
from tests.strategies import faults
from tests.unit.services.navigator.bench import X80, NavigatorBench

SQUARE = ((2.0, -1.0), (4.0, -1.0), (4.0, 1.0), (2.0, 1.0))
S = 1_000_000_000


def zone(name="cellar", corners=SQUARE, **asks):
    return ZoneConfig(corners=corners, **asks).zone(name)


def told(service, handler, *arguments):
    """The zones that a handler publishes, each as its names, and the reply."""
    found, recovery_steps = [], iter(handler(*arguments))
    while True:
        try:
            sent = next(recovery_steps)
        except StopIteration as end:
            return found, end.value
        if sent.topic is topics.ZONES:
            assert not list(faults(sent.message))
            found.append([z.name for z in sent.message.zones])


def fresh(*configured):
    service = NavigatorService(NavigatorConfig(zones=configured), X80)
    service.now = S
    return service


def test_without_zones_it_never_speaks_of_them():
    assert told(fresh(), fresh().tick)[0] == []


def test_the_configuration_s_hold_from_the_start_and_those_set_beside_them():
    service = fresh(NamedZoneConfig(name="stairs", corners=SQUARE), NamedZoneConfig(name="cellar", corners=SQUARE))
    assert told(service, service.tick)[0] == [["stairs", "cellar"]]
    assert told(service, service.tick)[0] == []
    names, reply = told(service, service.set_zones, SetZones(S, (zone(speed=0.2), zone("hall"))))
    assert (names, reply.accepted) == ([["stairs", "cellar", "hall"]], True)
    assert service.zones.zones[1].speed == 0.2
    assert told(service, service.set_zones, SetZones(S, ()))[0] == [["stairs", "cellar"]]


def test_after_a_restart_those_of_before_hold_again():
    service = fresh(NamedZoneConfig(name="stairs", corners=SQUARE))
    assert not list(service.zones_before_the_restart(Zones(0, (zone("hall"),))))
    assert told(service, service.tick)[0] == [["stairs", "hall"]]
    service = fresh()
    told(service, service.set_zones, SetZones(S, (zone("new"),)))
    assert not list(service.zones_before_the_restart(Zones(0, (zone("old"),))))
    assert [z.name for z in service.zones.zones] == ["new"]


def test_more_zones_than_a_message_holds_are_refused_and_the_others_stay():
    service = fresh(NamedZoneConfig(name="stairs", corners=SQUARE))
    told(service, service.set_zones, SetZones(S, (zone("old"),)))
    many = tuple(zone(f"zone {i}") for i in range(MAX_ZONES))
    reply = told(service, service.set_zones, SetZones(S, many))[1]
    assert (reply.accepted, reply.reason) == (False, reasons.BAD_REQUEST.code)
    assert [z.name for z in service.zones.zones] == ["stairs", "old"]
    service = fresh(NamedZoneConfig(name="stairs", corners=SQUARE))
    (log,) = service.zones_before_the_restart(Zones(0, many))
    assert many[-1].name in log.text
    assert [z.name for z in service.zones.zones] == ["stairs", *(z.name for z in many[:-1])]


def test_two_zones_of_one_name_are_refused():
    stairs = NamedZoneConfig(name="stairs", corners=SQUARE)
    with pytest.raises(ValidationError, match="two zones of one name: stairs"):
        NavigatorConfig(zones=(stairs, NamedZoneConfig(name="cellar", corners=SQUARE), stairs))
    assert SetZones(S, (zone(), zone(speed=0.3))).problem() == "two zones of one name"
    assert SetZones(S, (zone(), zone("hall"))).problem() is None


def test_a_route_through_a_keep_out_zone_is_refused_with_the_pose_and_the_present_task_goes_on():
    bench = NavigatorBench()
    bench.ask("set_zones", SetZones(bench.now, (zone(), zone("hall", speed=0.3))))
    bench.go(Pose2(6.0, 2.0))
    reply = bench.ask("navigate", Navigate(bench.now, (Pose2(1.0, 0.0), Pose2(3.0, 0.5)), 0.0, 1, True))
    assert (reply.accepted, reply.reason) == (False, reasons.GOAL_KEEP_OUT.code)
    assert reply.detail == "pose 2 of 2 is in cellar"
    bench.run(1)
    assert (bench.status.state, bench.goal.map_from_goal) == (NavState.NAVIGATING, Pose2(6.0, 2.0))


def test_of_a_long_route_each_zone_is_tested_once(monkeypatch):
    calls = []
    monkeypatch.setattr("shared.zones.contains", lambda *given: calls.append(given) or contains(*given))
    poses = (*(Pose2(0.01 * i, 5.0) for i in range(500)), Pose2(3.0, 0.0))
    zones = zone("stairs", ((9.0, 9.0), (10.0, 9.0), (10.0, 10.0))), zone(), zone("hall", speed=0.3)
    found = refused_pose(poses, OccupancyGrid(), None, X80.inscribed_radius, 0.15, zones, map_grows=True)
    assert found == (reasons.GOAL_KEEP_OUT, "pose 501 of 501 is in cellar")
    assert len(calls) <= len(zones)


def test_a_goal_that_becomes_forbidden_under_way_ends_the_task_with_the_reason_and_without_recoveries():
    bench = NavigatorBench()
    bench.go(Pose2(3.0, 0.0))
    bench.run(1)
    bench.refusal = reasons.GOAL_KEEP_OUT.code
    none = np.zeros(0)
    for _ in range(8):
        bench.call("plan", Path(bench.now, bench.goal.id, 1, reasons.GOAL_KEEP_OUT.code, none, none, none, 0.0, 0.0))
        bench.run(0.25)
    assert (bench.status.state, bench.status.reason) == (NavState.FAILED, reasons.GOAL_KEEP_OUT.code)
    assert bench.status.n_recoveries == 0
