# SPDX-License-Identifier: Apache-2.0
"""`zenav up`: the services as processes, until Ctrl-C. `zenav run`: one of them, in this process."""

import json
import runpy
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path

from shared import requests, topics
from shared.config import RobotFile, UserError, configured, nearest
from shared.extensions import service_module
from shared.messages import Health
from shared.runners.clock import clock_from
from shared.runners.presence import announce
from shared.runners.transport import StackAddress, stack_address
from shared.topics import OWN_SERVICES, SERVICES
from zenav.client import Client
from zenav.client.map_modes import OnMap
from zenav.console.run_folder import new_run_folder
from zenav.console.shutdown import StopFlag, stop_on_signal
from zenav.stack.config_report import read_sections
from zenav.stack.external import ExternalWatch, expected_topics
from zenav.stack.forked_check import begin_check, check_apart
from zenav.stack.gateway import GATEWAY, gateway_address, prepare_gateway, prepare_page, with_gateway
from zenav.stack.hardware import (
    Hardware,
    emulated_ports,
    require_world,
    services_for,
    settings_for,
    simulated_world,
)
from zenav.stack.heap import limit_heap, release_free_memory
from zenav.stack.launch import START_LIMIT, Launcher, claim_stack, service_command
from zenav.stack.page import SERVICE, PageOpener, page_url, with_page
from zenav.stack.ros2 import ROS2, check_router, ros2_settings
from zenav.stack.sd_notify import Notifier
from zenav.stack.service_loader import existing_services, service_class
from zenav.stack.uplink import UPLINK, check_uplink, uplink_settings
from zenav.stack.warm import warm_first

MAX_SILENCE_S = 5.0
"""Without a health message of any service for so long, the launcher gives systemd no sign of life."""

PERIOD_S = 0.1  # between two looks at the services


def run_service(service: str, robot: str, stack: str, settings: list[str], clock: str, memory: str, log: str) -> None:
    """One service in this process, as `python -m services.NAME` runs it. Does not return."""
    names = tuple(existing_services())
    if service not in names:
        raise UserError(f"{service} is not a service", nearest(service, names))
    warm_first(robot, settings, [service])
    sys.argv[:] = [service, "--robot", robot, "--stack", stack, "--log", log, "--clock", clock, "--memory", memory]
    for setting in settings:
        sys.argv += ["--set", setting]
    runpy.run_module(service_module(service), run_name="__main__", alter_sys=True)


def selected_services(only: Sequence[str], whole: list[str], external: Sequence[str] = ()) -> list[str]:
    """The services to start, in the registry's order, without the external ones. Raises UserError on a wrong name."""
    names = tuple(existing_services())
    for name in (*only, *external):
        if name not in names:
            raise UserError(f"{name} is not a service", nearest(name, names))
    selected = [name for name in names if name in (only or whole) and name not in external]
    if not selected:
        raise UserError("no service is left to start", "name others with --only, or fewer with --external")
    return selected


@dataclass(frozen=True, kw_only=True)
class UpOptions:
    """What a user asks of `zenav up`. Defaults: the whole stack of x80sv on the real robot, with a page.

    hardware: None is the simulator's messages with a world, else the real robot.
    only, external: services; external ones are not started, because programs of the user take their place.
    on_map: what the mapper begins with; a new map without it.
    page, browser: whether the page is served, and a browser shows it in a desktop session.
    remote: whether members reach the stack from other computers.

    ros2, site: routers of ROS 2 nodes and of a site, as tcp/HOST:7447 and tls/HOST:7449; empty: none.
    """

    robot: str = "x80sv"
    world: str = ""
    hardware: Hardware | None = None
    only: Sequence[str] = ()
    speed: float = 1.0
    stack: str = "0"
    settings: Sequence[str] = ()
    on_map: OnMap | None = None
    page: bool = True
    browser: bool = True
    remote: bool = False
    external: Sequence[str] = ()
    ros2: str = ""
    site: str = ""


@dataclass(slots=True)
class _StackPlan:
    """The checked options: services to start, with their settings, and the map to begin with until it is given."""

    options: UpOptions
    hardware: Hardware
    where: StackAddress
    file: RobotFile
    names: list[str]
    settings: list[str]
    saved: bytes | None
    url: str  # of the page; empty: none


def up(options: UpOptions) -> None:
    """Runs the services until Ctrl-C. Raises UserError where the options are wrong, before any service starts.

    The world is read after the services are loaded, with which it has its kernels' library in common.
    """
    limit_heap()  # before the first thread
    plan = _planned(options)
    clock = "" if options.speed == 1.0 else f"{time.time_ns()}:{options.speed:g}"
    clock_from(clock)
    with stop_on_signal() as stop, ExitStack() as open_things:
        if not plan.where.router:
            open_things.enter_context(claim_stack(plan.where.domain))
        folder = new_run_folder("up")
        settings = [*plan.settings, *settings_for(plan.hardware, plan.file, folder)]
        commands = {
            name: service_command(name, options.robot, options.stack, settings, clock, folder / "memory")
            for name in plan.names
        }
        open_things.callback(_remove_if_empty, folder)
        launcher = open_things.enter_context(Launcher(commands, folder, _print_line, 1 / options.speed))
        is_simulated = "sim" in plan.names
        check_world = begin_check(lambda: simulated_world(plan.file)) if is_simulated else lambda: None
        hears_clock = bool(clock or options.external)
        client = open_things.enter_context(Client(plan.file.robot.name, plan.where, hears_clock=hears_clock))
        token = announce(client.session, plan.file.robot.name, is_shared=bool(plan.where.router))
        open_things.callback(token.undeclare)
        watch = _external_watch(plan, client)
        running = _RunningStack(launcher, watch, PageOpener(plan.url, options.browser), folder)
        client.listen(topics.HEALTH, lambda health, _: running.hear(health))
        check_world()
        _print_start(plan, folder)
        launcher.start_all(lambda name: name in running.ready, stop.is_set)
        if not stop.is_set():
            _give_map(plan, client, launcher, stop)
        running.run_until(stop)


def _planned(options: UpOptions) -> _StackPlan:
    """Checks the options. Raises UserError."""
    hardware = chosen_hardware(options)
    where = stack_address(options.stack)
    settings = [*options.settings, *([f"sim.world={options.world}"] if options.world else [])]
    settings = with_gateway(settings, where) if options.remote else settings
    settings = [*ros2_settings(options.ros2), *settings] if options.ros2 else settings
    settings = [*uplink_settings(options.site), *settings] if options.site else settings
    file = configured(options.robot, settings)
    whole = services_for(hardware, file, meets_robots=bool(where.router or options.site))
    names = selected_services(options.only, with_page(whole, options.page), options.external)
    for name in names:
        if name in OWN_SERVICES:  # they are preloaded later: now, so that the check's copy has them too
            service_class(name)
    check_apart(lambda: read_sections(file))
    if options.on_map is not None and "mapper" not in (*names, *options.external):
        raise UserError("a map is for the mapper, which does not start", "add mapper to --only, or leave out --map")
    names += _checked_links(options, file)
    if "sim" in names:
        require_world(file)
    saved = None if options.on_map is None else options.on_map.read(file)
    if options.on_map is not None and not any(setting.startswith("recorder.attach=") for setting in settings):
        settings = [*settings, f"recorder.attach={json.dumps(options.on_map.files())}"]
    warm_first(options.robot, [*settings, *settings_for(hardware, file, None)], names)
    url = page_url(file, where) if SERVICE in names else ""
    prepare_page(url)
    return _StackPlan(
        options=options,
        hardware=hardware,
        where=where,
        file=file,
        names=names,
        settings=settings,
        saved=saved,
        url=url,
    )


def _checked_links(options: UpOptions, file: RobotFile) -> list[str]:
    """The services that link the stack to others, as the user asked. Raises UserError where they cannot run."""
    names = []
    if options.remote:
        prepare_gateway(file)
        names.append(GATEWAY)
    if options.ros2:
        check_router(file)
        names.append(ROS2)
    if options.site:
        check_uplink(file)
        names.append(UPLINK)
    return names


def _external_watch(plan: _StackPlan, client: Client) -> ExternalWatch:
    """Watches the messages of programs that take the place of services."""
    external = plan.options.external
    expected = expected_topics(plan.names, external, plan.file) if external or not plan.options.only else []
    if external:
        keys = ", ".join(topic.key for topic in expected) or "no messages"
        _print_zenav(f"{', '.join(external)}: not started here; waits for {keys}")
    return ExternalWatch(client, expected, plan.file.robot, _print_zenav)


class _RunningStack:
    """The launcher's loop: restarts services, and reports their state to the user and to systemd."""

    def __init__(self, launcher: Launcher, watch: ExternalWatch, opener: PageOpener, folder: Path) -> None:
        self.launcher, self.watch, self.opener, self.folder = launcher, watch, opener, folder
        self.ready: set[str] = set()  # services of which a health message came
        self._heard_at = 0.0  # s, monotonic: of the last health of any service

    def hear(self, health: Health) -> None:
        """Takes a service's health; called in the client's thread."""
        self.launcher.hear(health)
        self.opener.hear(health)
        self._heard_at = time.monotonic()
        if health.name not in self.ready and health.name in self.launcher.commands:
            self.ready.add(health.name)
            if self._is_ready:
                _print_zenav(self.watch.ready_text())

    def run_until(self, stop: StopFlag) -> None:
        """Works until `stop` is set."""
        systemd, is_announced = Notifier(), False
        while not stop.is_set():
            self.launcher.step()
            self.watch.step()
            if self._is_ready and not is_announced:
                is_announced = True
                systemd.ready()
                systemd.status(f"{len(self.ready)} services run; logs in {self.folder}")
            if time.monotonic() - self._heard_at < MAX_SILENCE_S:
                systemd.alive()
            self.launcher.pause(PERIOD_S)
        systemd.stopping()
        _print_zenav("ending")

    @property
    def _is_ready(self) -> bool:
        return len(self.ready) == len(self.launcher.commands)


def _give_map(plan: _StackPlan, client: Client, launcher: Launcher, stop: StopFlag) -> None:
    """Lets the mapper begin with the saved map, if there is one. Raises UserError where the mapper does not answer."""
    on_map = plan.options.on_map
    if on_map is not None and plan.saved is not None:
        limit = time.monotonic() + START_LIMIT
        while not client.answers(requests.GIVE_MAP, PERIOD_S):  # meanwhile a service that died is started again
            launcher.step()
            if stop.is_set():
                return
            if time.monotonic() > limit:
                raise UserError("the mapper does not answer: it has no map", f"see its log in {launcher.logs}")
        on_map.give(client, plan.saved)
        plan.saved = None
        release_free_memory()
        _print_zenav(f"the mapper has the map of {on_map.folder}: {on_map.mode}")


def _remove_if_empty(folder: Path) -> None:
    """Removes the folder of a run that ended before a service started."""
    with suppress(OSError):
        folder.rmdir()


def _print_start(plan: _StackPlan, folder: Path) -> None:
    """Says what starts, and where the user finds it."""
    _print_zenav(f"{', '.join(plan.names)}; logs in {folder}; Ctrl-C ends them")
    if plan.url:
        _print_zenav(f"the page is at {plan.url}")
    if plan.options.remote:
        _print_zenav(f"members connect to {gateway_address(plan.file)}")
    _print_hardware(plan.hardware, plan.file, folder, is_whole=not plan.options.only)


def _print_hardware(hardware: Hardware, file: RobotFile, folder: Path, is_whole: bool) -> None:
    """Says what the stack expects of a real robot, or where emulated ports are."""
    if hardware is Hardware.REAL and is_whole:
        _print_zenav("no world: expects the robot's hardware; simulate with --world office")
    if hardware is Hardware.EMULATED:
        ports = ", ".join(str(folder / port) for port in emulated_ports(file))
        _print_zenav(f"ports: {ports}; zenav fault breaks them")


def _print_zenav(line: str) -> None:
    _print_line("zenav", line)


def _print_line(name: str, line: str) -> None:
    colour = 31 + (SERVICES.index(name) + 1) % 6 if name in SERVICES else 1
    prefix = f"{name:<12}"
    with suppress(OSError):  # a terminal that was closed: the services are ended in order all the same
        sys.stderr.write(f"\033[{colour}m{prefix}\033[0m {line}\n" if sys.stderr.isatty() else f"{prefix} {line}\n")
        sys.stderr.flush()


def chosen_hardware(options: UpOptions) -> Hardware:
    """The hardware that fits the other options. Raises UserError where none does."""
    world, speed = options.world, options.speed
    if "sim" in options.external:
        if world or options.hardware is not None or speed != 1.0:
            raise UserError("an external simulator has its own world", "leave out --world, --hardware and --speed")
        return Hardware.MESSAGES
    chosen = options.hardware or (Hardware.MESSAGES if world else Hardware.REAL)
    if (chosen is Hardware.REAL) == bool(world):
        hint = "leave out --world" if world else "name one: --world office"
        raise UserError(f"{chosen} hardware is {'not ' if world else ''}in a simulated world", hint)
    if speed != 1.0 and not world:
        raise UserError("--speed needs the simulator's time", "name a world: --world office")
    return chosen
