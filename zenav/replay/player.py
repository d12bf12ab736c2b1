# SPDX-License-Identifier: Apache-2.0
"""`zenav replay FILE`: publishes a recording on Zenoh, at any rate, with keys for pause and seek.

Messages keep their bytes and stamps. `sim/clock` carries the recorded time for viewers, recorders and other tools.
Live services refuse these messages, because their stamps are old.
With `now`, every message gets a new stamp and keeps its age (time of logging minus stamp). Sessions are new in each
pass, sequences stay. So the checks of live services (publisher, session, sequence, age) give what they gave on the
robot. Journals name recorded bytes and are left out then.
"""

import os
import select
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from math import inf
from pathlib import Path

import zenoh

from shared import topics
from shared.codec import CodecError, Envelope, encode, envelope_of
from shared.config import UserError
from shared.messages import Clock
from shared.recording import Recording
from shared.recordings.latched_state import LatchedState
from shared.runners.transport import LatchedPublisher, StackAddress, stack_address
from shared.topics import SERVICES, Topic
from zenav.client import Client
from zenav.console.raw_terminal import raw_terminal
from zenav.console.shutdown import StopFlag, stop_on_signal
from zenav.replay import player_clock
from zenav.replay.player_clock import PlaybackOptions, Playhead, RecordingContents
from zenav.stack.launch import taken_ports

SETTLE = 1.3  # s until all clients have found the player: a client looks for a service once a second
LOOK = 0.05  # s between two looks at keys, clock and progress
BETWEEN = 0.5  # s between two passes: a new session is taken once the one before has been silent for 0.3 s
STEERS = {topics.PLAN.key: "local_ctrl"}
"""A key that is harmless but for this service, which drives by it."""
PAUSE, QUIT = " ", "q"
STEP, FASTER, SLOWER = ("n", "\x1b[C", "\x1bOC"), ("+", "\x1b[A", "\x1bOA"), ("-", "\x1b[B", "\x1bOB")
HELP = "space pauses, n or right steps, up and down change the rate, q ends"


Keys = Callable[[float], str]
"""Waits so many s at most and returns what was typed meanwhile."""
Show = Callable[[float, str], None]
"""(s from the recording's beginning, a few words)"""


def play(path: Path, robot: str, stack: str, wish: PlaybackOptions) -> int:
    """Plays a recording until its end, or until a person ends it. robot: its name; the recorded one where empty."""
    recording = Recording(path)
    there = player_clock.contents(recording)
    if wish.start >= there.seconds or (wish.end and wish.end <= wish.start):
        raise UserError(f"nothing lies between {wish.start:g} s and {wish.end or there.seconds:g} s of {path}",
                        f"it is {there.seconds:.1f} s long")  # fmt: skip
    keys = player_clock.selected_keys(wish.keys, there.keys)
    names = player_clock.renamed_keys(wish.remap, keys)
    name = robot or recording.about.get("robot", "")
    if not name:
        raise UserError(f"{path} does not say which robot it is of", "name one: --robot x80")
    where = stack_address(stack)
    with stop_on_signal() as stop, ExitStack() as screen:
        runs = running(name, where, stop)
        playing, left_out = check_allowed(keys, names, wish, runs)
        for why, them in left_out.items():
            sys.stderr.write(f"left out: {', '.join(them)}: {why}\n")
        if wish.now and wish.rate != 1.0:
            sys.stderr.write(f"at --rate {wish.rate:g} the robot moves otherwise than its odometry says\n")
        if not playing:
            raise UserError("nothing is left to be played", "choose other topics: --topics scan,odom")
        client = screen.enter_context(Client(name, where, "" if where.router else played_service(playing, runs)))
        stop.wait(SETTLE)
        if sys.stdin.isatty():
            type_ = partial(typed_keys, screen.enter_context(raw_terminal()))
            sys.stderr.write(f"{HELP}\n")
        else:
            type_ = partial(no_keys, stop)
        player = Player(
            client=client, recording=recording, there=there, playing=playing, wish=wish, keys=type_, stop=stop
        )
        with progress_display(path.name, there.seconds) as player.show:
            player.run()
    notes = [*dict.fromkeys(player.notes), *recording.problems]
    if player.n_bad:
        notes.append(f"{player.n_bad} recorded payloads that are no messages were left out")
    for note in notes:
        sys.stderr.write(f"{note}\n")
    sys.stdout.write(f"played {player.n_played} messages of {len(playing)} topics\n")
    return 0


def running(robot: str, where: StackAddress, stop: StopFlag) -> set[str]:
    """The services that run: those that hold their ports or, behind a router, those that publish their health."""
    if not where.router:
        return {name for name in SERVICES if taken_ports(where, (name,))}
    publishers: set[str] = set()
    with Client(robot, where) as client:
        client.listen(topics.HEALTH, lambda health, envelope: publishers.add(envelope.publisher))
        stop.wait(SETTLE)
    return publishers


def played_service(playing: Iterable[str], runs: set[str]) -> str:
    """The service whose part is played: one that does not run, of those that published what is played.

    Its port is where everybody looks for it: without one, tools and services would not find the player.
    """
    owners = {name for key in playing for name in owners_of(key)} - runs
    return next((name for name in SERVICES if name in owners), "")


def owners_of(key: str) -> set[str]:
    """The services that may publish a key."""
    topic = topics.topic_of(key)
    if topic is None:
        return set()
    return {key.rpartition("/")[2]} if topic.by == "*" else set(topic.publishers)


def check_allowed(
    keys: list[str], names: dict[str, str], wish: PlaybackOptions, runs: set[str]
) -> tuple[dict[str, str], dict[str, list[str]]]:
    """By recorded key the key that it is played as; and by reason, which are left out.

    Raises UserError where one that was asked for by name may not be played.
    """
    playing: dict[str, str] = {}
    left_out: dict[str, list[str]] = {}
    asked = {word for word in wish.keys.split(",") if word}
    for key in keys:
        as_ = names.get(key, key)
        why = refusal_text(as_, wish, runs)
        if why is None:
            playing[key] = as_
        elif key in asked or key in names:
            raise UserError(f"{as_} is not played: {why[0]}", why[1])
        else:
            left_out.setdefault(why[0], []).append(as_)
    return playing, left_out


def refusal_text(key: str, wish: PlaybackOptions, runs: set[str]) -> tuple[str, str] | None:
    """Why a key may not be published here, and what to do about it; None where it may."""
    topic = topics.topic_of(key)
    if topic is None:
        return None
    if not wish.commands and (key in player_clock.COMMANDS or STEERS.get(key) in runs):
        return "robots obey it (--commands plays it all the same)", "--commands, if no real robot listens"
    live = [name for name in SERVICES if name in owners_of(key) & runs]
    if live:
        return f"{' and '.join(live)} runs", f"end {live[0]}, or play into another stack: --stack 1"
    if wish.now and topic is topics.JOURNAL:
        return "journals hold for recorded stamps only", "leave out --now"
    if topic is topics.CLOCK:
        return "the player publishes its own clock" if not wish.now else "now is now", "leave it out"
    return None


class Player:
    """Plays what is chosen, pass by pass."""

    def __init__(
        self,
        client: Client,
        recording: Recording,
        there: RecordingContents,
        playing: dict[str, str],
        wish: PlaybackOptions,
        keys: Keys,
        stop: StopFlag,
    ) -> None:
        self.n_played = self.n_bad = self.n_passes = 0
        self.notes: list[str] = []
        self.show: Show = lambda seconds, text: None
        self._client, self._recording, self._there, self._playing = client, recording, there, playing
        self._jumps = player_clock.silences(recording, there.first)
        self._wish, self._keys, self._stop = wish, keys, stop
        self._steps = self._recorded = 0
        self._ended = False
        self._epoch = client.now() - time.monotonic_ns()
        self._life = f"+{self._epoch + time.monotonic_ns():x}"
        self._head = Playhead(time.monotonic_ns())
        self._latched: dict[str, LatchedPublisher] = {}
        self._publishers = {key: self._publisher(topics.topic_of(key), key) for key in playing.values()}
        self._clock = None if wish.now else self._publisher(topics.CLOCK, topics.CLOCK.key)
        self._clock_due = self._n_clocks = 0
        self._sessions: set[str] = set()  # of the played health messages: another session is a live service
        self._came: set[str] = set()
        client.listen(topics.HEALTH, lambda health, envelope: self._hear(envelope))

    def run(self) -> None:
        """Returns when the recording, or a person, ends it."""
        paused = self._wish.paused
        while not self._over:
            self._pass(paused)
            self.n_passes += 1
            paused = False
            if not self._wish.loop:
                break
            self._rest()

    @property
    def _over(self) -> bool:
        return self._ended or self._stop.is_set()

    def _hear(self, envelope: Envelope) -> None:
        if envelope.session not in self._sessions:
            self._came.add(envelope.publisher)

    def _give_way(self) -> None:
        """What a service that came to life says itself is played no more."""
        came = set(self._came)
        for key in [key for key in self._publishers if owners_of(key) & came]:
            self.notes.append(f"{key} is played no more since {' and '.join(owners_of(key) & came)} runs")
            del self._publishers[key]
            self._latched.pop(key, None)

    def _publisher(self, topic: Topic | None, key: str) -> zenoh.Publisher:  # type: ignore[type-arg]  # of any message
        every = topic is None or topic.keep == "all"
        name = f"{self._client.robot}/{key}"
        if topic is not None and topic.latched:
            self._latched[key] = LatchedPublisher(self._client.session, name)
        return self._client.session.declare_publisher(
            name,
            congestion_control=zenoh.CongestionControl.BLOCK if every else zenoh.CongestionControl.DROP,
            express=True,
        )

    def _pass(self, paused: bool) -> None:
        start, end = self._wish.start * 1e9, (self._wish.end or inf) * 1e9
        latched, begun = LatchedState(), False
        entries = self._recording.entries(list(self._playing))
        for place, entry in player_clock.timed_entries(entries, self._there.first, self._jumps, self.notes):
            key = self._playing[entry.key]
            if place < start:
                latched.take(key, entry.payload)
                continue
            self._recorded = entry.log_time - place
            if not begun:
                begun = True
                self._head = Playhead(time.monotonic_ns(), self._wish.rate, paused, round(start))
                for latest in latched.values():
                    self._keep(latched, latest.key, round(start))
                    self._put(latest.key, latest.payload, round(start))
            if place > end or not self._reach(place):
                return
            if latched.take(key, entry.payload):
                self._keep(latched, key, place)
            self._put(key, entry.payload, place)

    def _reach(self, place: int) -> bool:
        """Waits until this place is due; False when somebody ended it before."""
        while not self._over:
            now = time.monotonic_ns()
            if now >= self._clock_due:
                self._look(now)
            if self._steps:
                self._steps -= 1
                self._head.step_to(place, now)
                return True
            wait = self._head.wait(place, now)
            if wait <= 0:
                return True
            self._act(self._keys(min(wait, LOOK)))
        return False

    def _rest(self) -> None:
        until = time.monotonic() + BETWEEN
        while not self._over and time.monotonic() < until:
            self._act(self._keys(LOOK))
        self._steps = 0

    def _look(self, now: int) -> None:
        """Keys that were typed, the clock, the display: 20 times a second, however fast it plays."""
        self._clock_due = now + round(LOOK * 1e9)
        self._act(self._keys(0.0))
        if self._came:
            self._give_way()
        place, head = self._head.place(now), self._head
        if self._clock is not None:
            stamp = self._recorded + place
            envelope = Envelope("sim", f"replay{self._life}", self._n_clocks, stamp)
            self._clock.put(encode(Clock(stamp, 0.0 if head.paused else head.rate), envelope))
            self._n_clocks += 1
        self.show(place / 1e9, "paused" if head.paused else f"x {head.rate:.3g}")

    def _act(self, text: str) -> None:
        now, head = time.monotonic_ns(), self._head
        while text:
            key = next((k for k in (*STEP, *FASTER, *SLOWER) if text.startswith(k)), text[0])
            text = text[len(key) :]
            if key in STEP:
                head.set_rate(now, paused=True)
                self._steps += 1
            elif key == PAUSE:
                head.set_rate(now, paused=not head.paused)
            elif key in FASTER:
                head.set_rate(now, rate=head.rate * player_clock.RATE_FACTOR)
            elif key in SLOWER:
                head.set_rate(now, rate=head.rate / player_clock.RATE_FACTOR)
            elif key == QUIT:
                self._ended = True

    def _wire(self, place: int) -> Callable[[bytes], bytes]:
        """What makes of a payload that was recorded at this place the bytes that go on the wire."""
        if not self._wish.now:
            return lambda payload: payload
        later = self._epoch + self._head.due(place) - (self._recorded + place)
        return partial(player_clock.restamped, later=later, life=f"{self._life}-{self.n_passes}")

    def _keep(self, latched: LatchedState, key: str, place: int) -> None:
        if key not in self._latched:
            return
        value, wire = latched.value(key), self._wire(place)
        self._latched[key].keep(lambda: wire(value()))

    def _put(self, key: str, payload: bytes, place: int) -> None:
        if key not in self._publishers:
            return
        try:
            on_wire = self._wire(place)(payload)
            if key.startswith(f"{topics.HEALTH.key}/"):
                self._sessions.add(envelope_of(on_wire).session)
        except CodecError:
            self.n_bad += 1
            return
        self._publishers[key].put(on_wire)
        self.n_played += 1


def typed_keys(terminal: int, seconds: float) -> str:
    """What was typed on a terminal within so many s; `q` when it is gone."""
    readable, _, _ = select.select([terminal], [], [], seconds)
    return (os.read(terminal, 256).decode(errors="replace") or QUIT) if readable else ""


def no_keys(stop: StopFlag, seconds: float) -> str:
    """Nothing, so many s later: there is no keyboard."""
    if seconds > 0:
        stop.wait(seconds)
    return ""


@contextmanager
def progress_display(name: str, seconds: float) -> Iterator[Show]:
    """A progress bar on a terminal: how far in the recording, at which rate."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    console = Console(stderr=True)
    columns = (
        TextColumn("{task.fields[name]}", markup=False),
        BarColumn(),
        TextColumn("{task.completed:.1f} of {task.total:.1f} s  {task.description}"),
    )
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("", total=seconds, name=name)
        yield lambda at, text: progress.update(task, completed=min(at, seconds), description=text)
