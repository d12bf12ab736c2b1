# SPDX-License-Identifier: Apache-2.0
"""A recording for pages that replay it: the messages and the map at each of its times.

An order says all that it needs, so any process can answer it. One recording stays open between orders.
"""

from pathlib import Path

from services.dashboard.frames import PAGE_KEYS
from shared import topics
from shared.config import UserError
from shared.lasers import laser_mounts
from shared.recording import Recording
from shared.types import NS_PER_S
from zenav.page.recordings import path_of
from zenav.page.replay_index import ReplayIndex
from zenav.page.replay_map import TileHistory
from zenav.page.replay_marks import MARK_KEYS, ReplayMarks
from zenav.page.target import PageTarget, Values
from zenav.recording.opening import open_recording, recorded_robot_file

REPLAYED_KEYS = frozenset(key for key in PAGE_KEYS if key != topics.MAP.key and not key.startswith("log/"))
"""Keys whose newest message a page gets: the map comes as tiles, and a log is no state."""
START_KEYS = frozenset((topics.GUARD.key, topics.POSE.key, topics.MAP.key))
RECENT_NS = NS_PER_S // 2  # of odometry: a scan is drawn where the robot was
MAX_PROBLEMS = 3


class OpenReplay:
    """An open recording. Raises UserError where the file is none, or holds nothing that can be read."""

    def __init__(self, path: Path) -> None:
        self.path = path
        recording = open_recording(path)
        self._index = ReplayIndex(recording, REPLAYED_KEYS | MARK_KEYS | {topics.MAP.key})
        if self._index.is_empty:
            raise UserError(f"{path.name} holds no message that can be read", "replay another recording")
        self._tiles, self._marks = TileHistory(), ReplayMarks(self._index.begin)
        firsts: dict[str, int] = {}
        for entry in recording.entries((MARK_KEYS | {topics.MAP.key}) & self._index.keys):
            (self._tiles if entry.key == topics.MAP.key else self._marks).add(entry)
            firsts[entry.key] = min(entry.log_time, firsts.get(entry.key, entry.log_time))
        self._starts = max((firsts[key] for key in START_KEYS & firsts.keys()), default=self._index.begin)

    def close(self) -> None:
        """Drops what it holds."""
        self._tiles.close()

    def summary(self) -> Values:
        """What a page needs once: length in s, marks, trail, robot (None: not recorded), and what is damaged.

        start: s, the first moment at which the robot's state, its place and a map are known.
        """
        recording = self._index.recording
        return {
            "name": self.path.name,
            "begin": self._index.begin / NS_PER_S,
            "length": (self._index.end - self._index.begin) / NS_PER_S,
            "start": (self._starts - self._index.begin) / NS_PER_S,
            "robot": _robot(recording),
            "marks": self._marks.marks,
            "trail": self._marks.trail,
            "problems": recording.damage[:MAX_PROBLEMS],
        }

    def state(self, t: float, since: float | None, first: int) -> Values:
        """The state at t (s from its begin). since: s, the state whose map the page has.  first: see TileHistory."""
        time = self._time(t)
        tiles = self._tiles.at(time, None if since is None else self._time(since), first, self._index.begin)
        return {"t": t, "stamp": time, "messages": self._messages(time) if first == 0 else [], "tiles": tiles}

    def _messages(self, time: int) -> list[tuple[str, bytes]]:
        """Key and bytes of the newest message of each key; before that of `odom`, those just before."""
        recent = self._index.between(topics.ODOM.key, time - RECENT_NS, time)[:-1]
        newest = (self._index.newest(key, time) for key in sorted(REPLAYED_KEYS))
        return [(entry.key, entry.payload) for entry in (*recent, *newest) if entry is not None]

    def _time(self, t: float) -> int:
        return self._index.begin + round(t * NS_PER_S)


class Replays:
    """The recording that is open, if one is."""

    def __init__(self) -> None:
        self._open: OpenReplay | None = None

    def open(self, target: PageTarget, values: Values) -> Values:
        """Opens a recording again, as far as it is written now; returns its summary."""
        return self._opened(Path(path_of(target, values)), again=True).summary()

    def at(self, target: PageTarget, values: Values) -> Values:
        """The state of a recording at `t`."""
        replay = self._opened(Path(path_of(target, values)))
        return replay.state(values["t"], values.get("since"), values.get("first", 0))

    def close(self) -> None:
        """Closes what is open."""
        if self._open is not None:
            self._open.close()
        self._open = None

    def _opened(self, path: Path, again: bool = False) -> OpenReplay:
        if self._open is None or self._open.path != path or again:
            self.close()
            self._open = OpenReplay(path)
        return self._open


REPLAYS = Replays()


def _robot(recording: Recording) -> Values | None:
    try:
        file = recorded_robot_file(recording)
        robot = file.robot if file is not None else None
    except UserError:
        return None  # a configuration that is damaged, or of another version: the page has the robot of today
    if robot is None:
        return None
    return {
        "name": robot.name,
        "outline": robot.corners.tolist(),
        **laser_mounts(robot),
    }
