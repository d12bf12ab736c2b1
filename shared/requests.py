# SPDX-License-Identifier: Apache-2.0
"""Requests with an answer: a key, the service that answers, a typed request and a typed reply. Zenoh queries, live."""

from dataclasses import dataclass, field
from typing import Annotated, Any, Generic, TypeVar, cast

from shared import messages as m
from shared.geometry import Pose2
from shared.messages import Count, Flag, Message, Pose, Text, Unit
from shared.reasons import Reason
from shared.recording_requests import FetchRecording, ListRecordings, RecordingList, RecordingPart
from shared.topics import SERVICES

Q = TypeVar("Q", bound=Message)
R = TypeVar("R", bound=Message)


@dataclass(frozen=True, slots=True)
class Reply(Message):
    """Accepted, or refused with the reason and a hint; `task_id` is the navigator's number of the new task."""

    accepted: Flag
    reason: Text
    detail: Text
    task_id: Count = 0


MAX_ROUTE_POSES = 10_000
"""poses of one route: some 0.4 MiB on the wire, which carries 4."""
MAX_OTHERS = 20
"""other robots that a robot explores with."""
MIN_TOLERANCE = 0.01
"""m or rad: localization is not more exact."""


@dataclass(frozen=True, slots=True)
class Navigate(Message):
    """Drive through these poses in `map`, at most 10 000, dwelling at each. NaN-free; `any_heading` ignores their yaw.

    A pose without a stay whose heading does not matter, and after which others follow, is passed without a stop.
    `pass_through`: all but the last are passed so, whatever their headings are, and no stay counts.
    A tolerance of 0 is the navigator's own, as configured.
    """

    poses: Annotated[tuple[Pose, ...], Unit("m, m, rad")]
    dwell: m.Seconds
    loops: Annotated[int, Unit("rounds; 0 is for ever"), m.Within(0, 10**6)]
    any_heading: Flag
    dwells: Annotated[tuple[m.Seconds, ...], Unit("s, one a pose; none: `dwell` at each")] = ()
    tolerance: Annotated[float, Unit("m to a pose at which it is reached"), m.Within(0, 5)] = 0.0
    yaw_tolerance: Annotated[float, Unit("rad to its heading"), m.Within(0, 3.15)] = 0.0
    pass_through: Flag = False

    @property
    def stays(self) -> tuple[float, ...]:
        """s at each pose."""
        dwell = 0.0 if self.pass_through else self.dwell
        return self.dwells if self.dwells and not self.pass_through else (dwell,) * len(self.poses)

    def problem(self) -> str | None:
        if self.dwells and len(self.dwells) != len(self.poses):
            return f"{len(self.dwells)} stays for {len(self.poses)} poses"
        if 0 < self.tolerance < MIN_TOLERANCE or 0 < self.yaw_tolerance < MIN_TOLERANCE:
            return f"a tolerance under {MIN_TOLERANCE}"
        if len(self.poses) > MAX_ROUTE_POSES:
            return f"a route of {len(self.poses)} poses, where {MAX_ROUTE_POSES} are the limit"
        return None if self.poses else "a route of no poses"


@dataclass(frozen=True, slots=True)
class SetZones(Message):
    """Let these zones hold, with those of the configuration (of one name, these), instead of the ones set before."""

    zones: Annotated[tuple[m.Zone, ...], Unit("1")]

    def problem(self) -> str | None:
        if len(self.zones) > m.MAX_ZONES:
            return f"more than {m.MAX_ZONES} zones"
        return "two zones of one name" if len({zone.name for zone in self.zones}) < len(self.zones) else None


@dataclass(frozen=True, slots=True)
class Explore(Message):
    """Explore until no reachable frontier is left.

    `others`: names of the robots that explore the same building; each frontier is left to one of them. Their messages
    are in a frame that all have in common, in which the robot's `map` has this pose.
    """

    others: Annotated[tuple[Text, ...], Unit("1")] = ()
    common_from_map: Pose = field(default_factory=Pose2)

    def problem(self) -> str | None:
        return f"more than {MAX_OTHERS} other robots" if len(self.others) > MAX_OTHERS else None


@dataclass(frozen=True, slots=True)
class Cancel(Message):
    """Drop the task and stand."""


@dataclass(frozen=True, slots=True)
class Pause(Message):
    """Stand where you are and keep the task (`paused`), or go on."""

    paused: Flag


@dataclass(frozen=True, slots=True)
class Spin(Message):
    """Turn on the spot by an angle, positive to the left, and stand.

    It ends with a reason where something is in the way, and after `seconds` (0: 30 s). The guard holds as ever.
    """

    angle: Annotated[float, Unit("rad"), m.Within(-70, 70)]
    seconds: Annotated[float, Unit("s"), m.Within(0, 300)] = 0.0


@dataclass(frozen=True, slots=True)
class DriveStraight(Message):
    """Drive straight by a distance, negative: backward, and stand. Ends as `Spin`.

    The speed is that of `local_ctrl.manoeuvres.back_up_speed`.
    """

    distance: Annotated[float, Unit("m"), m.Within(-10, 10)]
    seconds: Annotated[float, Unit("s"), m.Within(0, 300)] = 0.0


@dataclass(frozen=True, slots=True)
class ClearCostmaps(Message):
    """Forget the obstacles and moving objects of the local costmap. The map, the zones and the guard's view stay.

    With a side only those in a square about the robot, along the axes of `odom`; with `outside` all others.
    """

    side: Annotated[float, Unit("m; 0: everything"), m.Within(0, 1000)] = 0.0
    outside: Flag = False


MAX_OVERRIDE_S = 2.0
"""s that one request overrides. A client repeats the request, so an override ends with its client."""


@dataclass(frozen=True, slots=True)
class Override(Message):
    """Let teleoperation creep through the protective field and without scans, for so long from now on; 0: end it.

    STOP and the base's faults still hold, and STOP ends it. Nothing else does anything about what is in the way.
    """

    seconds: Annotated[float, Unit("s"), m.Within(0, MAX_OVERRIDE_S)]


@dataclass(frozen=True, slots=True)
class Watch(Message):
    """Publish the debug topics for so long from now on; 0: stop. A viewer asks again and again.

    Those of local control are `debug/costmap`, `debug/rollouts` and, where moving obstacles are tracked,
    `debug/moving_obstacles`. That of the mapper is `debug/graph`, that of the planner `debug/global_costmap`.
    """

    seconds: Annotated[float, Unit("s"), m.Within(0, 60)]


@dataclass(frozen=True, slots=True)
class LoadMap(Message):
    """Take this map (its tool read the file; saving is the tool's too, from the latched `map`) and start on it."""

    map: Annotated[m.MapUpdate, Unit("tiles")]
    map_from_base: Pose


MAP_PART = 2**20
"""bytes of a saved map that one message carries at most."""
MAX_MAP_PARTS = 512
"""parts of one map: 512 MiB, some 30 000 keyframes of 450 beams."""


@dataclass(frozen=True, slots=True)
class FetchMap(Message):
    """A part of the present map as the file graph.msgpack; `copy` names the copy that is being fetched, 0: make one."""

    copy: Count
    part: Count


@dataclass(frozen=True, slots=True)
class MapPart(Message):
    """The part; or a refusal, of which `busy` is one to ask again after. `parts` is 0 while the copy is made."""

    accepted: Flag
    reason: Text
    detail: Text
    copy: Count = 0
    parts: Count = 0
    data: Annotated[bytes, Unit("bytes")] = b""


@dataclass(frozen=True, slots=True)
class GiveMap(Message):
    """A part of a file graph.msgpack for the mapper, from the first to the last; `transfer` is the giver's number.

    With `resumes` it is the graph of the present map, from before a restart, and `transfer` is the map's id. The mapper
    then takes it up without a further request.
    """

    transfer: Count
    part: Annotated[int, Unit("1"), m.Within(0, MAX_MAP_PARTS - 1)]
    parts: Annotated[int, Unit("1"), m.Within(1, MAX_MAP_PARTS)]
    data: Annotated[bytes, Unit("bytes")]
    resumes: Flag = False

    def problem(self) -> str | None:
        if len(self.data) > MAP_PART:
            return f"a part of over {MAP_PART} bytes"
        return None if self.part < self.parts else "a part beyond the last one"


@dataclass(frozen=True, slots=True)
class StartMap(Message):
    """Go on in a mode: on the map of a transfer, or on the present one (`transfer` 0).

    at: the robot's pose on it, which is checked against the scan. Without it the robot is searched on the whole map. On
    the present map it is where it was tracked. A new map starts where the robot stands.
    name: of the map of a transfer, for `MapState`.
    """

    mode: Annotated[m.MapMode, Unit("1")]
    transfer: Count
    at: Annotated[tuple[Pose, ...], Unit("m, m, rad")] = ()
    name: Text = ""

    def problem(self) -> str | None:
        if len(self.at) > 1:
            return "more than one pose"
        return "a new map has no place yet" if self.mode is m.MapMode.MAP and (self.transfer or self.at) else None


@dataclass(frozen=True, slots=True)
class NameMap(Message):
    """The present map was saved under this name, or its folder was renamed; empty: it has no name any more."""

    name: Text


@dataclass(frozen=True, slots=True)
class EditMap(Message):
    """Remove edits of the present map by their ids, or all (`clear`), then add others, whose ids the mapper chooses.

    map_id: of the map that they were drawn on, which must be the present one; 0: whichever is present.
    """

    add: Annotated[tuple[m.MapEdit, ...], Unit("1")]
    remove: Annotated[tuple[Count, ...], Unit("1")] = ()
    clear: Flag = False
    map_id: m.Stamp = 0

    def problem(self) -> str | None:
        return f"more than {m.MAX_EDITS} edits" if max(len(self.add), len(self.remove)) > m.MAX_EDITS else None


@dataclass(frozen=True, slots=True)
class Break(Message):
    """Let this fault of the simulated hardware begin, for so many seconds (0: until it is ended), or end it (`mended`).

    `fault` is a name that `zenav fault` lists. To end all faults it is empty.
    """

    fault: Text
    seconds: m.Seconds
    mended: Flag


MAX_VALUE_LENGTH = 200
"""characters of the text of one setting."""


@dataclass(frozen=True, slots=True)
class SetSettings(Message):
    """Set these settings of a service while it runs: all of them, or none. An empty value: back to that of its start.

    check: change nothing, and reply whether the service would accept it. Without names the reply gives what holds.
    """

    names: Annotated[tuple[str, ...], Unit("dotted, as in a robot's file")]
    values: Annotated[tuple[str, ...], Unit("YAML, one a name")]
    check: Flag

    def problem(self) -> str | None:
        if len(self.names) != len(self.values):
            return f"{len(self.values)} values for {len(self.names)} names"
        if len(set(self.names)) < len(self.names):
            return "one setting twice"
        long = any(len(text) > MAX_VALUE_LENGTH for text in (*self.names, *self.values))
        return f"a text of over {MAX_VALUE_LENGTH} characters" if long else None


@dataclass(frozen=True, slots=True)
class SettingsReply(Message):
    """Accepted, or refused with the fault and a hint; and what holds now of the settings that may change.

    started: the value with which the service was started: that of the robot's file, or of `--set`.
    """

    accepted: Flag
    reason: Text
    detail: Text
    hint: Text = ""
    names: Annotated[tuple[str, ...], Unit("dotted, as in a robot's file")] = ()
    values: Annotated[tuple[str, ...], Unit("YAML, one a name")] = ()
    started: Annotated[tuple[str, ...], Unit("YAML, one a name")] = ()


@dataclass(frozen=True, slots=True)
class Request(Generic[Q, R]):
    """One row: `by` is the service that answers; "*" is every service: then the key ends in its name.

    crosses: a site may ask it. Replies begin with `accepted`, `reason` and `detail`: a refusal has one shape for all.
    """

    key: str
    request: type[Q]
    reply: type[R]
    by: str
    crosses: bool = False

    @property
    def services(self) -> tuple[str, ...]:
        """The services that answer."""
        return SERVICES if self.by == "*" else (self.by,)

    @property
    def keys(self) -> tuple[str, ...]:
        """All keys without the robot's name."""
        return tuple(dict.fromkeys(self.key_of(service) for service in self.services))

    def key_of(self, service: str) -> str:
        """The key without the robot's name under which this service answers."""
        return f"{self.key}/{service}" if self.by == "*" else self.key

    def refusal(self, stamp: int, reason: Reason, detail: str) -> Message:
        """The reply that refuses a request. stamp: ns."""
        reply: Any = self.reply
        return cast(Message, reply(stamp, False, reason.code, detail))


NAVIGATE = Request("request/navigate", Navigate, Reply, by="navigator", crosses=True)
SET_ZONES = Request("request/set_zones", SetZones, Reply, by="navigator", crosses=True)
EXPLORE = Request("request/explore", Explore, Reply, by="navigator", crosses=True)
CANCEL = Request("request/cancel", Cancel, Reply, by="navigator", crosses=True)
PAUSE = Request("request/pause", Pause, Reply, by="navigator", crosses=True)
SPIN = Request("request/spin", Spin, Reply, by="navigator")
DRIVE_STRAIGHT = Request("request/drive_straight", DriveStraight, Reply, by="navigator")
CLEAR_COSTMAPS = Request("request/clear_costmaps", ClearCostmaps, Reply, by="local_ctrl")
OVERRIDE = Request("request/override", Override, Reply, by="guard")
WATCH = Request("request/watch", Watch, Reply, by="local_ctrl")
WATCH_GRAPH = Request("request/watch_graph", Watch, Reply, by="mapper")
WATCH_GLOBAL_COSTMAP = Request("request/watch_global_costmap", Watch, Reply, by="planner")
LOAD_MAP = Request("request/load_map", LoadMap, Reply, by="mapper")
FETCH_MAP = Request("request/fetch_map", FetchMap, MapPart, by="mapper")
GIVE_MAP = Request("request/give_map", GiveMap, Reply, by="mapper")
START_MAP = Request("request/start_map", StartMap, Reply, by="mapper")
NAME_MAP = Request("request/name_map", NameMap, Reply, by="mapper")
EDIT_MAP = Request("request/edit_map", EditMap, Reply, by="mapper")
WATCH_LINK = Request("request/watch_link", Watch, Reply, by="uplink", crosses=True)
LIST_RECORDINGS = Request("request/list_recordings", ListRecordings, RecordingList, by="recorder", crosses=True)
FETCH_RECORDING = Request("request/fetch_recording", FetchRecording, RecordingPart, by="recorder", crosses=True)
FAULT = Request("request/fault", Break, Reply, by="sim")
SET = Request("request/set", SetSettings, SettingsReply, by="*")

REQUESTS: tuple[Request[Message, Message], ...] = tuple(r for r in list(globals().values()) if isinstance(r, Request))
