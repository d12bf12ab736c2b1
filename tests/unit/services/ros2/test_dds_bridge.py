# SPDX-License-Identifier: Apache-2.0
"""The format of zenoh-bridge-ros2dds: keys are names, tokens as its sources make them, no attachments."""

import threading

import pytest

from services.ros2.rmw_names import Durability, Entity, Qos, Reliability, RosName
from services.ros2.robot_input import COMMAND, STAMPED_COMMAND
from services.ros2.ros_format import TWIST_BYTES, DdsBridgeFormat
from services.ros2.ros_types import Distro, ros_types
from shared import sample_messages, topics
from shared.config import load_robot
from shared.ros_messages import RosFrames, RosMessages
from tests.unit.services.ros2.network import LIMIT_S, bridged, repeated

FORMAT = DdsBridgeFormat()
ZID = "8a3f"
SCAN = RosName("/scan", "sensor_msgs/msg/LaserScan", "RIHS01_1")
TWISTS = tuple(RosName("/cmd_vel", f"geometry_msgs/msg/{name}", "") for name in ("Twist", "TwistStamped"))
TYPES = ros_types(Distro.JAZZY)
MAKE = RosMessages(TYPES.types, RosFrames())
TRIGGER = "std_srvs/srv/Trigger"


@pytest.mark.parametrize(
    ("entity", "topic", "qos", "token"),
    [
        (Entity.PUBLISHER, SCAN, Qos(depth=5), "MP/scan/sensor_msgs§msg§LaserScan/:1:0:0,5:typehash=RIHS01_1;"),
        (
            Entity.PUBLISHER,
            RosName("/robot1/map", "nav_msgs/msg/OccupancyGrid", "RIHS01_2"),
            Qos(durability=Durability.TRANSIENT_LOCAL, depth=1),
            "MP/robot1§map/nav_msgs§msg§OccupancyGrid/:1:1:0,1:typehash=RIHS01_2;",
        ),
        (
            Entity.SUBSCRIPTION,
            RosName("/cmd_vel", "geometry_msgs/msg/Twist", "RIHS01_3"),
            Qos(Reliability.BEST_EFFORT, depth=1),
            "MS/cmd_vel/geometry_msgs§msg§Twist/:0:0:0,1:typehash=RIHS01_3;",
        ),
        (Entity.SERVICE, RosName("/estop", TRIGGER, ""), Qos(), "SS/estop/std_srvs§srv§Trigger"),
        (
            Entity.SERVICE,
            RosName("/navigate_to_pose/_action/send_goal", "nav2_msgs/action/NavigateToPose_SendGoal", ""),
            Qos(),
            "AS/navigate_to_pose/nav2_msgs§action§NavigateToPose",
        ),
    ],
)
def test_a_token_is_that_of_the_bridges_sources(entity, topic, qos, token):
    assert FORMAT.endpoint_token(ZID, 4, entity, topic, qos) == f"@/{ZID}/@ros2_lv/{token}"


@pytest.mark.parametrize("part", ["get_result", "cancel_goal", "feedback", "status"])
def test_the_other_parts_of_an_action_have_no_token(part):
    name = RosName(f"/navigate_to_pose/_action/{part}", "nav2_msgs/action/NavigateToPose_X", "")
    assert FORMAT.endpoint_token(ZID, 4, Entity.PUBLISHER, name, Qos()) == ""


def test_a_token_is_read():
    token = FORMAT.endpoint_token(ZID, 1, Entity.SUBSCRIPTION, SCAN, Qos(Reliability.BEST_EFFORT))
    endpoint = FORMAT.endpoint_of(token)
    assert endpoint is not None
    assert (endpoint.topic.name, endpoint.topic.type, endpoint.node) == ("/scan", SCAN.type, f"the bridge {ZID}")
    assert endpoint.qos.reliability is Reliability.BEST_EFFORT
    assert FORMAT.endpoint_of(f"@/{ZID}/@ros2_lv") is None
    assert FORMAT.endpoint_of(f"@/{ZID}/@ros2_lv/MP/a/b/c") is None


@pytest.mark.parametrize("is_stamped", [False, True])
def test_a_velocity_is_told_from_a_stamped_one_by_its_length(is_stamped):
    message = MAKE.twist(0.1, 0.2)
    if is_stamped:
        message = MAKE.new("geometry_msgs/msg/TwistStamped", header=MAKE.header(0, ""), twist=message)
    data = TYPES.encode(message)
    assert (len(data) == TWIST_BYTES) != is_stamped
    assert FORMAT.type_of("cmd_vel", TWISTS, len(data)) == message.__msgtype__


def test_a_scan_goes_out_a_velocity_comes_in_and_a_service_replies_without_attachments():
    robot = load_robot("x80sv").robot
    with bridged(bridge="dds") as (bridge, stack, peer):
        found, came = [], threading.Event()

        def file(sample) -> None:
            found.append(sample)
            came.set()

        peer.session.declare_subscriber("scan", file)
        repeated(
            stack, lambda: topics.SCAN(sample_messages.scan(stack.now(), robot.laser)), lambda limit: came.wait(limit)
        )
        assert found[0].attachment is None
        assert len(TYPES.decode(found[0].payload.to_bytes(), SCAN.type).ranges) == robot.laser.n_beams
        peer.session.put("cmd_vel", TYPES.encode(MAKE.twist(0.1, 0.0)))
        assert bridge.wait_event("message")["type"] == "geometry_msgs/msg/Twist"
        response = TYPES.encode(TYPES.new(f"{TRIGGER}_Response", success=True, message=""))

        def answer() -> None:
            bridge.order(reply=bridge.wait_event("request")["id"], data=response)

        thread = threading.Thread(target=answer)
        thread.start()
        [reply] = list(peer.session.get("estop", payload=b"\x00\x01\x00\x00\x00", timeout=LIMIT_S))
        thread.join()
        assert reply.ok is not None
        assert reply.ok.payload.to_bytes() == response
        tokens = [str(r.ok.key_expr) for r in peer.session.liveliness().get("@/*/@ros2_lv/**", timeout=5.0) if r.ok]
        assert any(token.endswith("/AS/follow_waypoints/nav2_msgs§action§FollowWaypoints") for token in tokens)


@pytest.mark.parametrize("stamped", [False, True])
def test_of_both_velocities_the_one_that_the_robot_subscribes_to_goes_out(stamped):
    twist = MAKE.twist(0.1, 0.2)
    types = {
        COMMAND: TYPES.encode(twist),
        STAMPED_COMMAND: TYPES.encode(MAKE.new(TWISTS[1].type, header=MAKE.header(0, ""), twist=twist)),
    }
    wanted = STAMPED_COMMAND if stamped else COMMAND
    with bridged(bridge="dds", drives=True) as (bridge, _, peer):
        came, found = threading.Event(), []

        def file(sample) -> None:
            found.append(sample.payload.to_bytes())
            came.set()

        peer.session.declare_subscriber("cmd_vel", file)
        token = FORMAT.endpoint_token(ZID, 1, Entity.SUBSCRIPTION, TWISTS[stamped], Qos())
        held = peer.session.liveliness().declare_token(token)
        for _ in range(100):
            for name, data in types.items():
                bridge.order(publish=name, data=data)
            if came.wait(0.1):
                break
        assert set(found) == {types[wanted]}
        held.undeclare()
