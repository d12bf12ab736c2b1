# SPDX-License-Identifier: Apache-2.0
"""A ROS bag as the stack's messages: which topics, which frames, which clock, and where the laser sits."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from shared.config import Mount, UserError, nearest
from shared.geometry import Pose2
from shared.messages import LaserScan, Localization, MapUpdate, Message, Odometry, PoseEstimate
from shared.ros_frames import Frames, level, planar, tilt, upside_down
from shared.ros_messages import GRID, ODOM, POSE, POSE_COVARIANCE, SCAN, TF, pose2
from shared.ros_readings import covariance, frame_name, laser_scan, stamp_of, transform_row
from shared.types import Float64s, Int64s
from zenav.convert import ros_messages as ros
from zenav.convert.content import MAX_MOUNT_M, Choice, Content, odometry_at
from zenav.convert.ros_files import BagContent, RawMessage, read_bag

M = TypeVar("M", bound=Message)
T = TypeVar("T")

BASES = "base_footprint", "base_link", "base", "chassis"  # REP 105, and what else people write
ANOTHER_CLOCK = 3600 * 10**9  # ns that a header may be off the usual from when it was recorded: farther is damage
MOVED = 0.01  # m, rad of a laser on its robot


@dataclass(slots=True)
class TopicTimes:
    """The messages of one topic: when each was recorded and, by its header, true, ns; and what it says."""

    topic: str
    frame: str
    received: Int64s
    header: Int64s
    messages: list[Any]
    other: str = ""  # the child frame, where there is one

    @property
    def unstamped(self) -> bool:
        """Whether the publisher sets no stamps."""
        return bool((self.header <= 0).mean() > 0.5)


def read_ros(path: Path, choice: Choice) -> Content:
    """The scans, the odometry and the poses of a bag.

    Raises UserError where it cannot be read, or does not hold what was chosen.
    """
    return _LogReader(path, read_bag(path, ros.WANTED), choice).content()


class _LogReader:
    def __init__(self, path: Path, bag: BagContent, choice: Choice) -> None:
        self.path, self.bag, self.choice = path, bag, choice
        self.n_bad = 0
        self.notes = list(bag.notes)
        self.transforms = self._transforms()
        self.frames = self._frames(by_receipt=False)

    def content(self) -> Content:
        odom = self._topic_times(self._chosen(self.choice.odom, (ODOM,), _odometry_rank, "odometry", "--topic-odom"))
        scan = self._topic_times(
            self._chosen(self.choice.scan, (SCAN, ros.ECHOES), self._scan_rank, "laser", "--topic-scan")
        )
        pose = self._topic_times(
            self._chosen(self.choice.pose, (POSE_COVARIANCE, POSE), _pose_rank, "pose", "--topic-pose")
        )
        by_receipt = self._clock([times for times in (scan, odom) if times is not None])
        if by_receipt:
            self.frames = self._frames(by_receipt=True)
        base = self._base(scan, odom)
        messages: list[tuple[str, Message]] = []
        track = self._odometry(odom, base, by_receipt) or self._odometry_of_tf(base)
        scans, mount = self._scans(scan, base, by_receipt)
        messages += [("odom", message) for message in track]
        messages += [("scan", message) for message in scans]
        messages += [("pose", message) for message in self._poses(pose, base, by_receipt, track)]
        messages += [("map", message) for message in self._map(by_receipt)]
        if scans and not track:
            self.notes.append("no odometry, neither as a topic nor in tf: scans alone must do, so a map is a guess")
        messages.sort(key=lambda row: row[1].stamp)
        topics = ", ".join(
            f"{topic} ({type_.replace('/msg/', '/')})" for topic, (type_, _) in sorted(self.bag.topics.items())
        )
        return Content(messages, mount, self.n_bad, self.notes, f"its topics: {topics or 'none'}")

    # --- which topics -----------------------------------------------------------------------------------------------

    def _chosen(
        self, named: str, types: tuple[str, ...], rank: Callable[[list[RawMessage]], Any], what: str, option: str
    ) -> list[RawMessage]:
        """The messages of the topic that was named, or of the best one; none where there is none."""
        by_topic: dict[str, list[RawMessage]] = {}
        for raw in self.bag.messages:
            if raw.type in types:
                by_topic.setdefault(raw.topic, []).append(raw)
        if named:
            topic = next((topic for topic in by_topic if topic.strip("/") == named.strip("/")), None)
            if topic is None:
                raise UserError(f"{self.path}: no topic {named} with {what}", nearest(named, tuple(sorted(by_topic))))
            return by_topic[topic]
        ranks = {topic: rank(raws) for topic, raws in by_topic.items()}
        fit = sorted(
            (topic for topic in ranks if ranks[topic] is not None), key=lambda t: (ranks[t], [-ord(c) for c in t])
        )
        if not fit:
            return []
        if len(fit) > 1:
            others = ", ".join(reversed(fit[:-1]))
            self.notes.append(
                f"{what} from {fit[-1]}; there is {others} too" + (f" ({option} TOPIC)" if option else "")
            )
        return by_topic[fit[-1]]

    def _scan_rank(self, raws: list[RawMessage]) -> Any:
        """Rank of a laser: level, with a wide field of view, and with many scans."""
        for raw in raws[:20]:
            try:
                message = ros.read(raw)
                scan = laser_scan(message, 0, mirrored=False)
            except ValueError:
                continue
            laser = frame_name(message.header.frame_id)
            pose = self.frames.find(self.frames.ancestors(laser)[-1], laser, np.zeros(1, np.int64))
            eighths = int(abs(scan.angle_increment) * len(scan.ranges) / (np.pi / 4) + 0.5)
            return pose is None or level(pose[0]), eighths, len(raws)
        return False, 0, 0

    # --- messages and clocks ----------------------------------------------------------------------------------------

    def _topic_times(self, raws: list[RawMessage]) -> TopicTimes | None:
        rows = []
        for raw in raws:
            message = self._good(ros.read, raw)
            if message is not None and 0 <= raw.received < 2**62:
                rows.append((raw.received, stamp_of(message.header), message))
        if not rows:
            return None
        received, header = (np.array(column, np.int64) for column in list(zip(*rows))[:2])
        first = rows[0][2]
        return TopicTimes(
            topic=raws[0].topic,
            frame=frame_name(first.header.frame_id),
            received=received,
            header=header,
            messages=[row[2] for row in rows],
            other=frame_name(getattr(first, "child_frame_id", "")),
        )

    def _good(self, make: Callable[..., T], *arguments: Any) -> T | None:
        """What a function makes of a message; None, and one more bad one, where that makes no sense."""
        try:
            return make(*arguments)
        except (ValueError, OverflowError, TypeError, AttributeError):
            self.n_bad += 1
            return None

    def _clock(self, topics: list[TopicTimes]) -> bool:
        """Whether the times of recording replace the stamps, because headers have none, or those of two clocks."""
        bare = [topic.topic for topic in topics if topic.unstamped]
        if bare:
            self.notes.append(
                f"{' and '.join(bare)} without stamps: the times at which messages were recorded were taken"
            )
            return True
        for other in topics[1:]:
            if _apart(topics[0].header, other.header) and not _apart(topics[0].received, other.received):
                self.notes.append(
                    f"{topics[0].topic} and {other.topic} are stamped by different clocks: the times at which "
                    "messages were recorded were taken"
                )
                return True
        return False

    def _made(self, topic: TopicTimes | None, make: Callable[[Any, int], M], by_receipt: bool) -> list[M]:
        """A topic's messages as the stack's, in time; those with a stamp that cannot be are bad ones."""
        if topic is None:
            return []
        by_receipt = by_receipt or topic.unstamped
        stamps = topic.received if by_receipt else topic.header
        late = topic.header - topic.received
        sane = (stamps > 0) | by_receipt
        if not by_receipt:
            sane &= np.abs(late - np.median(late)) <= ANOTHER_CLOCK
        converted = []
        for stamp, message, is_sane in zip(stamps.tolist(), topic.messages, sane):
            self.n_bad += not is_sane
            made = self._good(make, message, stamp) if is_sane else None
            if made is not None:
                converted.append(made)
        return sorted(converted, key=lambda message: message.stamp)

    # --- frames -----------------------------------------------------------------------------------------------------

    def _transforms(self) -> list[tuple[str, str, int, int, Float64s, bool]]:
        """parent, child, stamp by the header, when it was recorded, the transform, whether it stands for ever."""
        rows = []
        for raw in self.bag.messages:
            if raw.type not in (TF, ros.OLD_TF):
                continue
            message = self._good(ros.read, raw) if 0 <= raw.received < 2**62 else None
            static = raw.topic.endswith("tf_static")
            for transform in message.transforms if message is not None else ():
                parent, child = frame_name(transform.header.frame_id), frame_name(transform.child_frame_id)
                stamp = stamp_of(transform.header)
                rows.append((parent, child, stamp, raw.received, transform_row(transform.transform), static))
        return rows

    def _frames(self, by_receipt: bool) -> Frames:
        frames = Frames()
        for parent, child, header, received, transform, static in self.transforms:
            try:
                frames.add(parent, child, received if by_receipt else header, transform, static)
            except ValueError:
                self.n_bad += not by_receipt
        return frames

    def _odom_frame(self, of: str) -> str | None:
        """The frame of odometry among a frame's ancestors."""
        if self.choice.odom_frame:
            return frame_name(self.choice.odom_frame)
        above = self.frames.ancestors(of)
        return next((frame for frame in above[1:] if "odom" in frame.rpartition("/")[2]), None)

    def _base(self, scan: TopicTimes | None, odom: TopicTimes | None) -> str:
        """The robot's frame: named, odometry's, below odometry's in tf, or by its usual names."""
        if self.choice.base_frame:
            return frame_name(self.choice.base_frame)
        if odom is not None and odom.other:
            return odom.other
        leaf = (
            scan.frame if scan is not None else next((row[1] for row in self.transforms if row[1].endswith(BASES)), "")
        )
        above = self.frames.ancestors(leaf)
        odom_frame = self._odom_frame(leaf)
        if odom_frame in above:
            return above[above.index(odom_frame) - 1]
        return self._holder(leaf) or above[-1]

    def _holder(self, laser: str) -> str | None:
        """The robot's frame among the laser's ancestors, by its usual names; None without one."""
        above = self.frames.ancestors(laser)[1:]
        return next((frame for name in BASES for frame in above if frame.rpartition("/")[2] == name), None)

    # --- what comes out ---------------------------------------------------------------------------------------------

    def _scans(self, topic: TopicTimes | None, base: str, by_receipt: bool) -> tuple[list[LaserScan], Mount]:
        if topic is None:
            return [], Mount()
        stamps = np.sort(topic.received if by_receipt else topic.header)
        poses = self.frames.find(base, topic.frame, stamps) if topic.frame else None
        holder = self._holder(topic.frame)
        if poses is None and holder and not self.choice.base_frame:
            self.notes.append(f"no tf leads from {base or 'the base'} to {topic.frame}: its place on {holder} is taken")
            poses = self.frames.find(holder, topic.frame, stamps)
        if poses is None:
            if self.choice.base_frame:
                raise UserError(
                    f"{self.path}: no tf leads from {base} to {topic.frame}, the frame of {topic.topic}",
                    nearest(
                        base, tuple(sorted({row[0] for row in self.transforms} | {row[1] for row in self.transforms}))
                    ),
                )
            self.notes.append(
                f"no tf leads from {base or 'the base'} to {topic.frame or 'the laser'}: "
                "the laser is taken to sit on the axis and look ahead"
            )
            poses = np.eye(4)[None]
        if not level(poses[0]):
            raise UserError(
                f"{self.path}: the laser of {topic.topic} is tilted by {tilt(poses[0]):.0f} degrees, off the plane",
                "choose another one: --topic-scan TOPIC",
            )
        places = [planar(pose) for pose in poses]
        mount = places[len(places) // 2]
        if any(mount.distance(place) > MOVED or abs((mount.inverse() @ place).yaw) > MOVED for place in places):
            self.notes.append(f"{topic.frame} moves on {base}: its place in the middle of the bag is taken")
        mirrored = upside_down(poses[0])
        if mirrored:
            self.notes.append(f"the laser of {topic.topic} hangs upside-down: its beams were turned about")
        scans = self._made(topic, lambda m, stamp: laser_scan(m, stamp, mirrored), by_receipt)
        if max(abs(mount.x), abs(mount.y)) > MAX_MOUNT_M:
            raise UserError(
                f"{self.path}: by tf the laser sits at {mount.x:.1f} {mount.y:.1f} m of {base}",
                "name the robot's frame: --base-frame",
            )
        return scans, Mount(x=mount.x, y=mount.y, yaw=mount.yaw)

    def _odometry(self, topic: TopicTimes | None, base: str, by_receipt: bool) -> list[Odometry]:
        track = self._made(topic, ros.odometry, by_receipt)
        if topic is None or base == topic.other or not topic.other:
            return track
        poses = self.frames.find(topic.other, base, np.zeros(1, np.int64))
        if poses is None:
            return track
        other_from_base = planar(poses[0])
        return [Odometry(o.stamp, o.odom_from_base @ other_from_base, o.v, o.w, o.covariance) for o in track]

    def _odometry_of_tf(self, base: str) -> list[Odometry]:
        odom_frame = self._odom_frame(base)
        rows = self._moving(odom_frame, base) if odom_frame is not None else []
        if rows:
            self.notes.append(f"odometry from tf: {odom_frame} to {base}")
        return [Odometry(stamp, pose, *speed, np.zeros(9)) for (stamp, pose), speed in zip(rows, _speeds(rows))]

    def _moving(self, target: str, source: str) -> list[tuple[int, Pose2]]:
        """Poses of a frame in another one, at every stamp of a moving transform between them."""
        above = self.frames.ancestors(source)
        between = above[: above.index(target)] if target in above else []
        moving = [frame for frame in between if self.frames.moves(frame)]
        if not moving:
            return []
        stamps_by_frame = [stamps[stamps > 0] for stamps in map(self.frames.stamps, moving)]
        if any(not len(stamps) for stamps in stamps_by_frame):
            return []
        stamps = np.unique(np.concatenate(stamps_by_frame))
        stamps = stamps[
            (stamps >= max(s[0] for s in stamps_by_frame)) & (stamps <= min(s[-1] for s in stamps_by_frame))
        ]
        poses = self.frames.find(target, source, stamps)
        return [(int(t), planar(pose)) for t, pose in zip(stamps, poses)] if poses is not None else []

    def _map(self, by_receipt: bool) -> list[MapUpdate]:
        """The last map; costmaps are none."""
        topic = self._topic_times(self._chosen("", (GRID,), _map_rank, "map", ""))
        return self._made(topic, ros.occupancy, by_receipt)

    def _poses(
        self, topic: TopicTimes | None, base: str, by_receipt: bool, track: list[Odometry]
    ) -> list[PoseEstimate]:
        """The pose on the map: of its topic, or in tf; with what that corrects of odometry."""

        def pose_estimate(message: Any, stamp: int) -> PoseEstimate:
            pose = message.pose
            spread = covariance(pose.covariance) if hasattr(pose, "covariance") else np.zeros(9)
            return _estimate(stamp, pose2(pose.pose if hasattr(pose, "covariance") else pose), spread)

        poses = self._made(topic, pose_estimate, by_receipt)
        maps = [frame for frame in self.frames.ancestors(base) if frame.rpartition("/")[2] == "map"]
        if topic is None and maps:
            poses = [_estimate(stamp, pose, np.zeros(9)) for stamp, pose in self._moving(maps[0], base)]
        odom_from_base = odometry_at([pose.stamp for pose in poses], track)
        return [replace(p, map_from_odom=p.map_from_base @ o.inverse()) for p, o in zip(poses, odom_from_base)]


def _estimate(stamp: int, map_from_base: Pose2, spread: Float64s) -> PoseEstimate:
    return PoseEstimate(
        stamp=stamp,
        map_from_base=map_from_base,
        map_from_odom=map_from_base,
        covariance=spread,
        quality=1.0,
        state=Localization.GOOD,
    )


def _odometry_rank(raws: list[RawMessage]) -> Any:
    """Dead reckoning rather than a pose on the map or a simulator's truth; then the more usual name, then how much."""
    topic = raws[0].topic
    try:
        frame = frame_name(ros.read(raws[0]).header.frame_id).rpartition("/")[2]
    except ValueError:
        frame = ""
    drifts = frame not in ("map", "world", "earth", "utm") and not any(w in topic for w in ("truth", "gps", "global"))
    return drifts, "odom" in topic, topic.rpartition("/")[2] == "odom", len(raws)


def _pose_rank(raws: list[RawMessage]) -> Any:
    """What localises the robot; goals and first guesses are poses too, and no place of it."""
    topic = raws[0].topic
    if any(word in topic for word in ("goal", "initial", "clicked", "target", "truth")):
        return None
    return "amcl" in topic or topic.rpartition("/")[2] == "pose", raws[0].type == POSE_COVARIANCE, len(raws)


def _map_rank(raws: list[RawMessage]) -> Any:
    topic = raws[0].topic
    return None if "cost" in topic else (topic.rpartition("/")[2] == "map", topic.endswith("map"))


def _apart(a: Int64s, b: Int64s) -> bool:
    """Whether two topics' times have nothing in common."""
    return bool(a.max() < b.min() or b.max() < a.min())


def _speeds(rows: list[tuple[int, Pose2]]) -> list[tuple[float, float]]:
    """m/s and rad/s by the motion since the row before."""
    speeds = [(0.0, 0.0)]
    for (before, a), (now, b) in pairwise(rows):
        step, seconds = a.inverse() @ b, max((now - before) * 1e-9, 1e-3)
        v, w = step.x / seconds, step.yaw / seconds
        speeds.append((v, w) if abs(v) <= 20 and abs(w) <= 50 else (0.0, 0.0))
    return speeds[: len(rows)]
