# SPDX-License-Identifier: Apache-2.0
"""A service is an object with handlers that a runner calls. There are four kinds of event: message, tick, job result
and request. At the end comes `on_shutdown`.

    class OdometryService(Service):
        config_type = OdometryConfig

        @on(topics.WHEELS)
        def wheels(self, wheels: WheelState) -> Out:
            yield topics.ODOM(...)

        @every(hz=2)
        def report(self) -> Out: ...

        @answer(requests.LOAD_MAP)
        def load(self, request: LoadMap) -> Answer[Reply]:
            yield topics.MAP(...)
            return Reply(...)

Handlers read only their arguments, their state and `self.now`. They open no file or socket, never sleep, and publish by
yielding. Slow work is yielded as a `Job`: a pure function of a snapshot. Its result is an event.
"""

from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

from shared import reasons, requests, topics
from shared.config import Robot, Section, UserError
from shared.messages import Message, RuntimeSettings
from shared.ports import PortConfig
from shared.rejections import Rejections
from shared.requests import Request, SetSettings, SettingsReply
from shared.settings import Configuration, changed_values, present_values, reconfigured, taken_by
from shared.topics import Publication, Topic

M = TypeVar("M", bound=Message)
Q = TypeVar("Q", bound=Message)
R = TypeVar("R", bound=Message)
S = TypeVar("S", bound="Service")


@dataclass(frozen=True, slots=True)
class Job:
    """Work off the event path: `function(*arguments)` is pure; its result calls the method named `done`.

    takes: s, its duration in lockstep. A service's jobs run one at a time, in their order.
    """

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    done: str
    takes: float


@dataclass(frozen=True, slots=True)
class Log:
    """A line of the service's log. level: "INFO", "WARNING" or "ERROR"."""

    level: str
    text: str


Out = Iterable[Publication | Job | Log]
Answer = Generator[Publication | Job | Log, None, R]


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """State for a service's next process that is too large for a latched topic.

    version: another one where the content is another.  function(*arguments) is pure, and runs off the event path. It
    gives the requests that the next process gets after its latched values. As events they are in its journal.
    """

    version: object
    function: Callable[..., list[tuple[Request[Any, Any], Message]]]
    arguments: tuple[Any, ...]


def on(topic: Topic[M], waits: bool = False) -> Callable[[Callable[[S, M], Out]], Callable[[S, M], Out]]:
    """Marks the handler of a topic's messages.

    waits: a live service handles its messages together, right before the next event. For a handler that only stores:
    an arrival then does not wake the process.
    """

    def mark(handler: Callable[[S, M], Out]) -> Callable[[S, M], Out]:
        handler.event = ("waits" if waits else "on", topic)  # type: ignore[attr-defined]  # functions carry their registration
        return handler

    return mark


def every(hz: float, after: "Topic[Any] | None" = None) -> Callable[[Callable[[S], Out]], Callable[[S], Out]]:
    """Marks a handler called at a fixed rate on the stack's clock. A missed tick is skipped.

    after: a topic that the service subscribes to. A tick then comes right after each of its messages.
    """

    def mark(handler: Callable[[S], Out]) -> Callable[[S], Out]:
        handler.event = ("every", (hz, after.key if after else ""))  # type: ignore[attr-defined]  # functions carry their registration
        return handler

    return mark


def answer(request: Request[Q, R]) -> Callable[[Callable[[S, Q], Answer[R]]], Callable[[S, Q], Answer[R]]]:
    """Marks the handler that answers a request; the reply is the generator's return value."""

    def mark(handler: Callable[[S, Q], Answer[R]]) -> Callable[[S, Q], Answer[R]]:
        handler.event = ("answer", request)  # type: ignore[attr-defined]  # functions carry their registration
        return handler

    return mark


class Service:
    """Base of all services. The runner sets `now` (ns, the stack's clock) before each event."""

    config_type: ClassVar[type[Section]] = Section
    name: str = ""  # set by the runner, as in the registry
    now: int = 0

    def __init__(self, config: Any, robot: Robot) -> None:
        self.config = config
        self.robot = robot
        self.started = Configuration(config, robot)
        self.run_time: dict[str, str] = {}
        """Settings that were set since its start: name -> value as YAML."""
        self.rejections = Rejections()
        """Messages that it did not use: its handlers judge stamps, the runner adds its own rejections."""

    def warm_up(self) -> None:
        """Compiles the kernels that events need, without a change of state. Called before the first event."""

    @property
    def ports(self) -> dict[str, PortConfig]:
        """Its ports by name. It reads them on topics.RX and topics.PORT, and writes to them on topics.TX."""
        return {}

    def on_shutdown(self) -> Out:
        """Publications at the end of the process. An event like the others."""
        return ()

    def checkpoint(self) -> Checkpoint | None:
        """Returns what its next process needs after a crash, beside latched values. It reads only: it is no event."""
        return None

    def state(self) -> str:
        """The service's activity in a few words, for the health message."""
        return "running"

    def settings_changed(self, old: Configuration, new: Configuration) -> Out:
        """Takes settings that changed while it runs. `config` and `robot` are the new ones already.

        What the constructor made from a setting of shared/settings.py is to be made again here.
        """
        return ()

    @answer(requests.SET)
    def set_settings(self, request: SetSettings) -> Answer[SettingsReply]:
        """Sets settings, all or none, or says why not."""
        wanted = self.run_time | dict(zip(request.names, request.values, strict=True))
        try:
            for name in request.names:
                taken_by(self.name, name)
            values = {name: wanted[name] for name in sorted(wanted) if wanted[name]}
            new = reconfigured(self.name, self.started, values)
        except UserError as error:
            return self._settings_reply(error)
        if not request.check and values != self.run_time:
            yield from self._use_settings(values, new)
            yield topics.SETTINGS(RuntimeSettings(self.now, tuple(values), tuple(values.values())))
        return self._settings_reply(None)

    @on(topics.SETTINGS)
    def settings_before_restart(self, settings: RuntimeSettings) -> Out:
        """Restores the settings that were set before a restart."""
        values = dict(zip(settings.names, settings.values, strict=True))
        try:
            yield from self._use_settings(values, reconfigured(self.name, self.started, values))
        except UserError as error:  # the robot's file is another one now
            yield Log("WARNING", f"the settings from before the restart do not hold: {error.what}")
        yield topics.SETTINGS(RuntimeSettings(self.now, tuple(self.run_time), tuple(self.run_time.values())))

    def _use_settings(self, values: dict[str, str], new: Configuration) -> Out:
        old = Configuration(self.config, self.robot)
        changes = changed_values(self.name, old, new)
        self.run_time, self.config, self.robot = values, new.config, new.robot
        if changes:
            yield Log("INFO", f"set at run time: {', '.join(changes)}")
            yield from self.settings_changed(old, new)

    def _settings_reply(self, error: UserError | None) -> SettingsReply:
        present = present_values(self.name, Configuration(self.config, self.robot))
        started = present_values(self.name, self.started)
        return SettingsReply(
            stamp=self.now,
            accepted=error is None,
            reason=reasons.BAD_REQUEST.code if error else "",
            detail=error.what if error else "",
            hint=error.hint if error else "",
            names=tuple(present),
            values=tuple(present.values()),
            started=tuple(started.values()),
        )


@dataclass(frozen=True, slots=True)
class Handlers:
    """Handlers of a service class, in the order of its source."""

    topics: dict[str, tuple[Topic[Message], str]]  # topic key -> topic, method
    ticks: tuple[tuple[float, str, str], ...]  # Hz, method, key of the topic that it follows
    requests: dict[str, tuple[Request[Message, Message], str]]  # request key -> request, method
    waiting: frozenset[str] = frozenset()  # keys of the topics whose messages wait for the next event


def handlers(service: type[Service]) -> Handlers:
    """The handlers of a service class, from the decorators."""
    events: dict[str, Any] = {}
    for base in reversed(service.__mro__):
        events.update({name: f.event for name, f in vars(base).items() if hasattr(f, "event")})
    marks = [(kind, what, name) for name, (kind, what) in events.items()]
    return Handlers(
        {what.key: (what, name) for kind, what, name in marks if kind in ("on", "waits")},
        tuple((what[0], name, what[1]) for kind, what, name in marks if kind == "every"),
        {what.key: (what, name) for kind, what, name in marks if kind == "answer"},
        frozenset(what.key for kind, what, _ in marks if kind == "waits"),
    )


def outputs(result: Out | None) -> Iterator[Publication | Job | Log]:
    """The outputs of a handler, one by one; none for None."""
    return iter(result or ())
