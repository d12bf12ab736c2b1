# SPDX-License-Identifier: Apache-2.0
"""A simulator that speaks bytes: it is driven by them, says what it measures in them, and breaks on demand."""

import pytest

from services.base_driver import drrobot as driver
from services.base_driver.drrobot import MotorSensor, decode
from services.base_driver.kinematics import board_counts, wheel_speeds
from services.lidar_driver import ld06
from services.lidar_driver.device import PacketCounts
from services.lidar_driver.packet_framing import PacketFramer
from services.sim.hardware.faults import FAULT_DESCRIPTIONS, Fault
from shared import topics
from shared.drrobot import PC, Deframer, Type
from shared.messages import MotorCommand, SerialData
from shared.requests import Break
from tests.unit.services.sim.scenes import PERFECT, SENSING, TICK, X80SV, simulator, told
from tests.unit.services.sim.scenes import drive as driven_by_messages

EMULATED = {"hardware": "emulated", **PERFECT}


def command(v, w, life=200):
    left, right = board_counts(*wheel_speeds(v, w, X80SV.drive), X80SV.drive)
    return driver.command_all(Type.VELOCITY_ALL, left, right, life)


def drive(sim, seconds, data):
    sent = []
    for _ in range(round(seconds * 50)):
        if data:
            sent += sim.receive_bytes(SerialData(sim.now, "board", data))
        sim.now += TICK
        sent += sim.tick()
    return sent


def asked(sim, fault, seconds=0.0, mended=False):
    """The reply, and what was published before it."""
    answering, sent = sim.handle_fault_request(Break(sim.now, fault, seconds, mended)), []
    while True:
        try:
            sent.append(next(answering))
        except StopIteration as end:
            return end.value, sent


def plugs(sent):
    return [(p.port, p.open) for p in told(sent, "port/plug")]


def reports(sent):
    deframer = Deframer(PC)
    words = [decode(packet) for data in told(sent, "port/tx") for packet in deframer.packets(data.data)]
    return [word for word in words if isinstance(word, MotorSensor)]


def test_bytes_move_the_robot_as_messages_do():
    by_bytes, by_messages = simulator("empty", **EMULATED), simulator("empty", **PERFECT)
    sent = drive(by_bytes, 2.0, command(0.4, 0.3))
    truth = told(sent, "sim/truth")[-1]
    twin = list(driven_by_messages(by_messages, 2.0, 0.4, 0.3))
    assert truth.world_from_base.distance(told(twin, "sim/truth")[-1].world_from_base) < 0.002
    assert abs(truth.world_from_base.yaw - told(twin, "sim/truth")[-1].world_from_base.yaw) < 0.003
    board = told(twin, "hardware/board")[-1]
    left, right = reports(sent)[-1].counts
    assert (left, right) == pytest.approx((board.left_counts, board.right_counts), abs=2)
    assert told(sent, "hardware/board") == []
    assert len(reports(sent)) == 100


def test_the_robot_stands_after_the_command_s_time_limit():
    sim = simulator("empty", **EMULATED)
    drive(sim, 1.0, command(0.4, 0.0, 200))
    gone = told(drive(sim, 1.0, b""), "sim/truth")
    assert gone[8].v > 0.3
    assert gone[20].v == pytest.approx(0, abs=1e-9)
    assert told(drive(sim, 0.02, command(0.4, 0.0)), "sim/truth")[0].v > 0


def test_motor_messages_move_nothing_and_scans_stay_messages_without_an_emulated_laser():
    sim = simulator("room", **EMULATED)
    list(sim.motors(MotorCommand(sim.now, -500.0, 500.0)))
    sent = drive(sim, 1.0, b"")
    assert told(sent, "sim/truth")[-1].distance == 0
    assert len(told(sent, "scan")) == 9
    assert list(sim.ports) == ["board"]


def test_a_base_without_an_emulated_board_is_driven_and_reports_by_messages():
    sim = simulator("room", **EMULATED, emulation={"board_model": ""})
    sent = list(driven_by_messages(sim, 1.0, 0.4, 0.0))
    assert told(sent, "sim/truth")[-1].distance == pytest.approx(0.4, abs=0.01)
    assert len(told(sent, "hardware/board")) == 50
    assert told(sent, "hardware/odometry") == []


def test_a_simulator_of_messages_has_no_ports_hears_no_bytes_and_breaks_nothing():
    sim = simulator("room")
    assert sim.ports == {}
    assert list(sim.receive_bytes(SerialData(sim.now, "board", command(0.4, 0.0)))) == []
    reply, _ = asked(sim, "garbage")
    assert (reply.accepted, reply.reason) == (False, "bad_request")
    assert "--hardware emulated" in reply.detail


@pytest.mark.parametrize("fault", Fault)
def test_every_fault_can_be_asked_for_and_mended(fault):
    sim = simulator("room", SENSING, **EMULATED)
    reply, _ = asked(sim, fault.value)
    assert (reply.accepted, reply.detail) == (True, FAULT_DESCRIPTIONS[fault])
    drive(sim, 0.1, command(0.1, 0.0))
    reply, _ = asked(sim, fault.value, mended=True)
    assert (reply.accepted, reply.detail) == (True, "nothing is broken")


@pytest.mark.parametrize("fault", [Fault.LASER_2_STALLED, Fault.IMU_UNPLUGGED])
def test_a_fault_of_a_device_that_the_robot_lacks_is_refused_and_breaks_nothing(fault):
    sim = simulator("room", **EMULATED)
    reply, sent = asked(sim, fault.value)
    assert not reply.accepted
    assert reply.detail.startswith(f"{fault} has no effect: ")
    assert sent == []


def test_a_fault_that_nobody_knows_is_refused_with_the_nearest_name():
    sim = simulator("room", **EMULATED)
    for mended in (False, True):
        reply, _ = asked(sim, "garbag", mended=mended)
        assert (reply.accepted, reply.reason) == (False, "bad_request")
        assert "garbage" in reply.detail
    assert not asked(sim, "")[0].accepted


def test_mending_one_of_two_leaves_the_other():
    sim = simulator("room", **EMULATED)
    asked(sim, "garbage")
    asked(sim, "stuck_encoder")
    assert asked(sim, "garbage", mended=True)[0].detail == "broken now: stuck_encoder"
    assert asked(sim, "", mended=True)[0].detail == "nothing is broken"


def test_an_adapter_is_pulled_out_at_once_and_comes_back_at_its_time():
    sim = simulator("room", **EMULATED)
    drive(sim, 0.1, b"")
    _, sent = asked(sim, "unplugged", seconds=0.5)
    assert plugs(sent) == [("board", False)]
    assert plugs(drive(sim, 0.48, b"")) == []
    assert plugs(drive(sim, 0.04, b"")) == [("board", True)]
    assert plugs(drive(sim, 0.5, b"")) == []


@pytest.mark.parametrize(
    "fault", [Fault.LASER_STOPPED, Fault.LASER_GARBAGE, Fault.LASER_STALLED, Fault.LASER_UNPLUGGED]
)
def test_a_laser_of_messages_falls_silent_by_each_of_its_faults_and_has_no_adapter(fault):
    sim = simulator("room", **EMULATED)
    drive(sim, 0.5, b"")
    assert plugs(asked(sim, fault.value, seconds=0.5)[1]) == []
    assert told(drive(sim, 0.48, b""), "scan") == []
    assert len(told(drive(sim, 0.5, b""), "scan")) >= 4


def laser_bytes(sent):
    return b"".join(data.data for data in told(sent, "port/tx") if data.port == "laser")


@pytest.mark.parametrize("fault", [Fault.LASER_GARBAGE, Fault.LASER_STALLED])
def test_of_a_lasers_broken_line_nothing_can_be_read_until_it_is_mended(fault):
    sim = simulator("room", **EMULATED, emulation={"laser_model": "ld06"})
    framing = PacketFramer(ld06.LENGTH, ld06.is_header, ld06.is_checksum_valid, PacketCounts())
    assert len(framing.extract(laser_bytes(drive(sim, 0.5, b"")))[0]) > 100
    asked(sim, fault.value, seconds=0.5)
    broken = laser_bytes(drive(sim, 0.48, b""))
    assert bool(broken) is (fault is Fault.LASER_GARBAGE)
    assert len(framing.extract(broken)[0]) == 0
    assert len(framing.extract(laser_bytes(drive(sim, 0.5, b"")))[0]) > 100


def test_a_lasers_stalled_line_carries_nothing_to_it_either():
    sim = simulator("room", **EMULATED, emulation={"laser_model": "rplidar"})
    info = SerialData(sim.now, "laser", b"\xa5\x50")
    assert laser_bytes(sim.receive_bytes(info))
    asked(sim, "laser_stalled")
    assert laser_bytes(sim.receive_bytes(info)) == b""


def test_the_same_seed_and_events_give_the_same_bytes():
    def sent():
        sim = simulator("office", hardware="emulated", seed=3)
        asked(sim, "garbage", seconds=0.5)
        return [p.message.data for p in drive(sim, 1.0, command(0.3, 0.2)) if p.topic is topics.TX]

    assert sent() == sent()
