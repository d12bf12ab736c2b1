# SPDX-License-Identifier: Apache-2.0
"""The registry of topics: key, message type, publishers, rate, queue and maximum latency.

Subscriptions, recording channels, health limits, lockstep delays, docs, completion and the diagram come from it.
"""

from dataclasses import dataclass
from importlib import import_module
from typing import Generic, Literal, TypeVar

from shared import messages as m
from shared.extensions import extension_services, packages, topic_modules
from shared.user_error import UserError

M = TypeVar("M", bound=m.Message)

OWN_SERVICES = (
    "sim",
    "base_driver",
    "lidar_driver",
    "odometry",
    "mapper",
    "planner",
    "local_ctrl",
    "guard",
    "navigator",
    "recorder",
    "dashboard",
    "gateway",
    "ros2",
    "imu_driver",
    "uplink",
    "traffic",
)
SERVICES = (*OWN_SERVICES, *extension_services(packages()))
"""Fixed order: a service's index is its port offset, and the tie-break of the lockstep runner."""


@dataclass(frozen=True, slots=True)
class Crossing:
    """How a topic crosses the robot's link to a site (services/uplink).

    rest, driving, watched: the most messages a second on their way out in each state of the robot; 0 is none. watched:
    a page of the site shows this robot. inward: the topic comes from the site instead.
    """

    rest: float = 0.0
    driving: float = 0.0
    watched: float = 0.0
    inward: bool = False


@dataclass(frozen=True, slots=True)
class Publication:
    """A message for a topic, which a handler yields."""

    topic: "Topic[m.Message]"
    message: m.Message


@dataclass(frozen=True, slots=True)
class Topic(Generic[M]):
    """One row of the registry.

    - by: services that may publish, space separated. "operator" is a user's tool. "*" is any service: then the key ends
      in the publisher's name.
    - hz: expected rate, 0 for events.
    - keep: "latest" (a new message replaces an unread one) or "all" (a bounded queue).
    - within: s, maximum latency. Health checks it in a live stack, lockstep delays messages by it.
    - latched: a late subscriber gets the last value at once, merged where the message class can. A publisher that
      subscribes to its own latched topic gets its last value after a restart, and nothing else.
    - people: without a subscriber among the services, on purpose.
    - crosses: how it crosses to a site; None: it stays on the robot.
    - from_robots: a key of the other robots. The publisher's runner hears it from each of them. It publishes what it
      heard here, for the recorder, and gives it to its service.

    RX and PORT are data and state of a service's own ports (shared/ports.py). Its runner publishes them and gives them to
    this service only. TX and PLUG are data and plugs that the service writes to its ports.
    """

    key: str
    type: type[M]
    by: str
    hz: float
    keep: Literal["latest", "all"]
    within: float
    latched: bool = False
    people: bool = False
    crosses: Crossing | None = None
    from_robots: str = ""

    @property
    def publishers(self) -> tuple[str, ...]:
        return SERVICES if self.by == "*" else tuple(self.by.split())

    def __call__(self, message: M) -> Publication:
        """A publication of this message on this topic, for a handler to yield."""
        return Publication(self, message)  # type: ignore[arg-type]  # Topic is invariant in M; a publication only reads


# fmt: off
BOARD       = Topic("hardware/board",  m.BoardReport,   by="sim",                    hz=50, keep="all",    within=0.002)
MOTORS      = Topic("hardware/motors", m.MotorCommand,  by="base_driver",            hz=50, keep="latest", within=0.002)
BASE_MOTION = Topic("hardware/odometry", m.BaseOdometry, by="sim ros2",              hz=50, keep="all",    within=0.002)
VELOCITY    = Topic("hardware/velocity", m.Velocity,    by="base_driver",            hz=50, keep="latest", within=0.002)
IMU         = Topic("imu",             m.Imu,           by="base_driver sim imu_driver ros2", hz=50, keep="all", within=0.002)
CONTACTS    = Topic("hardware/contacts", m.Contacts,    by="base_driver sim ros2",   hz=20, keep="all",    within=0.002)
RX          = Topic("port/rx",         m.SerialData,    by="*",                      hz=0,  keep="all",    within=0.001, people=True)
TX          = Topic("port/tx",         m.SerialData,    by="*",                      hz=0,  keep="all",    within=0.001, people=True)
PORT        = Topic("port/state",      m.PortState,     by="*",                      hz=0,  keep="all",    within=0.001, people=True)
PLUG        = Topic("port/plug",       m.PortState,     by="*",                      hz=0,  keep="all",    within=0.001, people=True)
WHEELS      = Topic("base/wheels",     m.WheelState,    by="base_driver",            hz=50, keep="all",    within=0.002)
BASE_ODOMETRY = Topic("base/odometry", m.BaseOdometry,  by="base_driver",            hz=50, keep="all",    within=0.002)
RANGES      = Topic("base/ranges",     m.RangeReadings, by="base_driver",            hz=10, keep="latest", within=0.003)
BASE_STATUS = Topic("base/status",     m.BaseStatus,    by="base_driver",            hz=2,  keep="latest", within=0.010, latched=True, crosses=Crossing(0.2, 0.5, 1))
REPORT      = Topic("base/report",     m.BoardReport,   by="base_driver",            hz=50, keep="all",    within=0.002, people=True)
BOARD_IS    = Topic("base/board",      m.BoardStatus,   by="base_driver",            hz=2,  keep="latest", within=0.010, latched=True, people=True)
SCAN        = Topic("scan",            m.LaserScan,     by="lidar_driver sim ros2",  hz=10, keep="latest", within=0.005, crosses=Crossing(0, 0, 2))
SCAN_2      = Topic("scan_2",          m.LaserScan,     by="lidar_driver sim",       hz=10, keep="latest", within=0.005)
ODOM        = Topic("odom",            m.Odometry,      by="odometry",               hz=50, keep="all",    within=0.003, crosses=Crossing(0, 0, 5))
POSE        = Topic("pose",            m.PoseEstimate,  by="mapper",                 hz=10, keep="latest", within=0.025, latched=True, crosses=Crossing(0.2, 2, 5))
MAP         = Topic("map",             m.MapUpdate,     by="mapper",                 hz=2,  keep="all",    within=0.050, latched=True, crosses=Crossing(0, 0, 1))
MAP_STATE   = Topic("map/state",       m.MapState,      by="mapper",                 hz=0,  keep="latest", within=0.050, latched=True, people=True, crosses=Crossing(0.5, 0.5, 1))
GOAL        = Topic("goal",            m.Goal,          by="navigator",              hz=0,  keep="all",    within=0.005, latched=True, crosses=Crossing(0.5, 1, 2))
RECOVERY = Topic("recovery",        m.Recovery,      by="navigator",              hz=0,  keep="all",    within=0.005, latched=True)
ZONES       = Topic("zones",           m.Zones,         by="navigator",              hz=0,  keep="latest", within=0.010, latched=True, crosses=Crossing(0.1, 0.1, 1))
PLAN        = Topic("plan",            m.Path,          by="planner",                hz=2,  keep="latest", within=0.100, latched=True, crosses=Crossing(0.1, 0.5, 1))
LIMITS      = Topic("plan/limits",     m.GoalLimits,    by="planner",                hz=0,  keep="latest", within=0.010, latched=True)
FOLLOW      = Topic("follow/status",   m.FollowStatus,  by="local_ctrl",             hz=20, keep="latest", within=0.005)
NAV_STATUS  = Topic("nav/status",      m.NavStatus,     by="navigator",              hz=5,  keep="latest", within=0.010, latched=True, people=True, crosses=Crossing(1, 2, 5))
TASK        = Topic("nav/task",        m.NavTask,       by="navigator",              hz=0,  keep="latest", within=0.010, latched=True)
SHARE       = Topic("explore/share",   m.ExplorationShare, by="navigator",           hz=0,  keep="latest", within=0.010, latched=True)
OTHERS_SHARE = Topic("explore/others", m.ExplorationShare, by="operator",            hz=0,  keep="all",    within=0.010)
OTHERS_MAP  = Topic("explore/map",     m.MapUpdate,     by="navigator",              hz=0,  keep="all",    within=0.050, latched=True)
CMD_NAV     = Topic("cmd/nav",         m.Velocity,      by="local_ctrl",             hz=20, keep="latest", within=0.030)
TELEOP      = Topic("cmd/teleop",      m.Velocity,      by="operator dashboard ros2", hz=20, keep="latest", within=0.005)
ESTOP       = Topic("estop",           m.EmergencyStop, by="operator dashboard ros2 uplink", hz=0,  keep="all",    within=0.005, latched=True, crosses=Crossing(inward=True))
COSTMAP     = Topic("debug/costmap",   m.Costmap,       by="local_ctrl",             hz=0,  keep="latest", within=0.005, people=True)
ROLLOUTS    = Topic("debug/rollouts",  m.Rollouts,      by="local_ctrl",             hz=0,  keep="latest", within=0.005, people=True)
MOVING      = Topic("debug/moving_obstacles", m.MovingObstacles, by="local_ctrl",    hz=0,  keep="latest", within=0.005, people=True)
GRAPH       = Topic("debug/graph",     m.KeyframeGraph, by="mapper",                 hz=0,  keep="latest", within=0.050, people=True)
GLOBAL_COSTMAP = Topic("debug/global_costmap", m.Costmap, by="planner",              hz=0,  keep="latest", within=0.100, people=True)
GUARD       = Topic("guard/status",    m.GuardStatus,   by="guard",                  hz=10, keep="latest", within=0.005, latched=True, crosses=Crossing(0.5, 2, 5))
CMD_VEL     = Topic("cmd/vel",         m.Velocity,      by="guard",                  hz=20, keep="latest", within=0.003)
SETTINGS    = Topic("settings",        m.RuntimeSettings, by="*",                    hz=0,  keep="latest", within=0.100, latched=True, people=True)
HEALTH      = Topic("health",          m.Health,        by="*",                      hz=1,  keep="latest", within=0.100, people=True, crosses=Crossing(0, 0, 0.2))
LOG         = Topic("log",             m.LogLine,       by="*",                      hz=0,  keep="all",    within=0.100, people=True, crosses=Crossing(0, 0, 5))
JOURNAL     = Topic("journal",         m.Journal,       by="*",                      hz=1,  keep="all",    within=0.100, people=True)
INTENT      = Topic("traffic/intent",  m.RobotIntent,   by="traffic",                hz=0,  keep="latest", within=0.050, people=True, crosses=Crossing(1, 5, 5))
HEARD       = Topic("traffic/heard",   m.RobotIntent,   by="traffic",                hz=0,  keep="all",    within=0.050, from_robots="traffic/intent")
RIGHT_OF_WAY = Topic("traffic/right_of_way", m.RightOfWay, by="traffic",             hz=0,  keep="latest", within=0.010)
OTHER_ROBOTS = Topic("traffic/others", m.OtherRobots,   by="traffic",                hz=0,  keep="latest", within=0.010)
CLOCK       = Topic("sim/clock",       m.Clock,         by="sim",                    hz=50, keep="latest", within=0.002, people=True)
OTHERS      = Topic("sim/others",      m.RobotDiscs,    by="operator",               hz=0,  keep="latest", within=0.005)
TRUTH       = Topic("sim/truth",       m.Truth,         by="sim",                    hz=50, keep="all",    within=0.002, people=True)
# fmt: on

OWN_TOPICS: tuple[Topic[m.Message], ...] = tuple(t for t in list(globals().values()) if isinstance(t, Topic))


def _with_extensions() -> tuple[Topic[m.Message], ...]:
    """The rows of above, and those of users' packages. Raises UserError where names clash or a publisher is unknown."""
    rows = list(OWN_TOPICS)
    for service in extension_services(packages()):
        if service in OWN_SERVICES:
            raise UserError(f"a package has a service {service}, as zenav has", "give it another name")
    for module in topic_modules(packages()):
        for row in vars(import_module(module)).values():
            if not isinstance(row, Topic) or row in rows:
                continue
            if any(row.key == other.key for other in rows):
                raise UserError(f"{module} has a topic {row.key}, as zenav has", "give it another key")
            unknown = [name for name in row.publishers if name not in SERVICES]
            if unknown:
                raise UserError(
                    f"{module}: {unknown[0]} publishes {row.key}, and is no service", "see its entry points"
                )
            rows.append(row)
    return tuple(rows)


TOPICS = _with_extensions()
BY_KEY = {topic.key: topic for topic in TOPICS}


def key_of(topic: Topic[M], publisher: str) -> str:
    """The key without the robot's name: `health/mapper` for a family, else the topic's own."""
    return f"{topic.key}/{publisher}" if topic.by == "*" else topic.key


def topic_of(key: str) -> "Topic[m.Message] | None":
    """The registry's row for a key without the robot's name, or None."""
    return BY_KEY.get(key) or BY_KEY.get(key.rpartition("/")[0])


KEYS = tuple(key for topic in TOPICS for key in dict.fromkeys(key_of(topic, name) for name in topic.publishers))
"""Every key without the robot's name, those of families too."""
LATCHED_KEYS = tuple(key for key in KEYS if (row := topic_of(key)) is not None and row.latched)
"""Those of latched topics."""
