# SPDX-License-Identifier: Apache-2.0
"""`zenav up`: the services as processes, until Ctrl-C. `zenav run`: one of them, in this process."""

import json
import runpy
import sys
import time
from contextlib import ExitStack
from pathlib import Path

from shared import requests, topics
from shared.config import UserError, configured, nearest
from shared.messages import Health
from shared.runners.clock import clock_from
from shared.runners.transport import where_from
from shared.topics import SERVICES
from zenav.classes import built
from zenav.client import Client
from zenav.hardware import Hardware, emulated_ports, services_for, settings_for
from zenav.launch import Launcher, claimed, service_command
from zenav.map_modes import OnMap
from zenav.scene import world_of
from zenav.settings import checked
from zenav.stopping import stopping


def run(service: str, robot: str, stack: str, settings: list[str], clock: str, log: str) -> None:
    """One service in this process, as `python -m services.NAME` runs it. Does not return."""
    names = tuple(built())
    if service not in names:
        raise UserError(f"{service} is not a service", nearest(service, names))
    sys.argv[:] = [service, "--robot", robot, "--stack", stack, "--log", log, "--clock", clock]
    for setting in settings:
        sys.argv += ["--set", setting]
    runpy.run_module(f"services.{service}", run_name="__main__", alter_sys=True)


def chosen(only: list[str], whole: list[str]) -> list[str]:
    """The services to start, in the registry's order. Raises UserError on a name that is none."""
    names = tuple(built())
    for name in only:
        if name not in names:
            raise UserError(f"{name} is not a service", nearest(name, names))
    return [name for name in names if name in (only or whole)]


def run_folder(kind: str) -> Path:
    """A new folder out/KIND-DATE-TIME for what a run leaves behind. Raises UserError where it cannot be made."""
    base = Path("out") / f"{kind}-{time.strftime('%Y%m%d-%H%M%S')}"
    for i in range(100):
        folder = base if i == 0 else base.with_name(f"{base.name}-{i}")
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise UserError(f"cannot write to {folder}: {error.strerror}", "run it from a folder of yours") from None
        return folder
    raise UserError(f"{base} exists 100 times", "wait a second")


def up(
    robot: str,
    world: str,
    hardware: Hardware | None,
    only: list[str],
    speed: float,
    stack: str,
    settings: list[str],
    on_map: OnMap | None,
) -> None:
    """Runs the services until Ctrl-C. hardware: None is the simulator's messages with a world, else the real robot.

    on_map: what the mapper begins with; a new map without it.
    """
    hardware = hardware or (Hardware.MESSAGES if world else Hardware.REAL)
    if (hardware is Hardware.REAL) == bool(world):
        mend = "leave out --world" if world else "name one: --world office"
        raise UserError(f"{hardware} hardware is {'not ' if world else ''}in a simulated world", mend)
    if speed != 1.0 and not world:
        raise UserError("--speed needs the simulator's time", "name a world: --world office")
    settings = [*settings, *([f"sim.world={world}"] if world else [])]
    file = configured(robot, settings)
    checked(file)
    names = chosen(only, services_for(hardware, file))
    if "sim" in names:
        world_of(file)  # a wrong world is an error before any process starts
    saved = None if on_map is None else on_map.read(file)  # so is a damaged map
    if on_map is not None and not any(setting.startswith("recorder.attach=") for setting in settings):
        settings.append(f"recorder.attach={json.dumps(on_map.files())}")
    where = where_from(stack)
    clock = "" if speed == 1.0 else f"{time.time_ns()}:{speed:g}"
    clock_from(clock)
    with stopping() as stop, ExitStack() as open_things:
        if not where.router:
            open_things.enter_context(claimed(where.domain))
        folder = run_folder("up")
        settings += settings_for(hardware, file, folder)
        commands = {name: service_command(name, robot, stack, settings, clock, folder / "memory") for name in names}
        _tell("zenav", f"{', '.join(names)}; logs in {folder}; Ctrl-C ends them")
        if not world and not only:
            _tell("zenav", "no world: expects the robot's hardware; simulate with --world office")
        if hardware is Hardware.EMULATED:
            ports = ", ".join(str(folder / port) for port in emulated_ports(file))
            _tell("zenav", f"ports: {ports}; zenav fault breaks them")
        launcher = open_things.enter_context(Launcher(commands, folder, _tell, 1 / speed))
        client = open_things.enter_context(Client(file.robot.name, where))
        ready: set[str] = set()

        def hear(health: Health) -> None:
            launcher.hear(health)
            if health.name not in ready and health.name in commands:
                ready.add(health.name)
                if len(ready) == len(commands):
                    _tell("zenav", "every service runs")

        client.listen(topics.HEALTH, lambda health, _: hear(health))
        launcher.start_all(lambda name: name in ready, stop.is_set)
        if on_map is not None and saved is not None and not stop.is_set():
            client.answers(requests.GIVE_MAP, 10.0)
            on_map.give(client, saved)
            _tell("zenav", f"the mapper has the map of {on_map.folder}: {on_map.mode}")
        while not stop.wait(0.1):
            launcher.step()
        _tell("zenav", "ending")


def _tell(name: str, line: str) -> None:
    colour = 31 + (SERVICES.index(name) + 1) % 6 if name in SERVICES else 1
    prefix = f"{name:<12}"
    sys.stderr.write(f"\033[{colour}m{prefix}\033[0m {line}\n" if sys.stderr.isatty() else f"{prefix} {line}\n")
    sys.stderr.flush()
