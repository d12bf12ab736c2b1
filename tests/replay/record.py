# SPDX-License-Identifier: Apache-2.0
"""Makes tests/replay/recordings again: `make record-references`, after a change that is meant to change what they say.

Each is a short run of the whole stack in lockstep, with all topics and journals. It is the input of the replays, and
what the services published is their reference. `make record-references ARGS="driving exploring"` makes only these.
Figures of a run that changed are printed.
"""

import shared.repeatable  # noqa: F401  # before numpy

# isort: split
import sys
from collections.abc import Callable
from pathlib import Path

from shared import requests, topics
from shared.config import configured
from shared.geometry import Pose2
from shared.messages import EmergencyStop
from shared.recording import CONFIG, Recording, Writer, about, sink
from shared.requests import Explore, Navigate
from shared.runners.host import Sent
from shared.runners.lockstep import Lockstep
from zenav.metrics.run_metrics import Metrics, comparison_table, run_from_entries, run_metrics
from zenav.stack.hardware import Hardware, services_for, settings_for, wires
from zenav.stack.service_loader import build_service

FOLDER = Path(__file__).parent / "recordings"
WORLDS = Path("tests/replay/worlds")  # from the checkout's root: a recording holds no path of a machine
SECONDS = 5.0  # of driving


def path_of(name: str) -> Path:
    return FOLDER / f"{name}.mcap"


class ReferenceRun:
    """The whole stack but for the recorder, in lockstep, recorded."""

    def __init__(self, record: Callable[[Sent], None], world: str, robot: str, hardware: Hardware) -> None:
        file = configured(robot, [f"sim.world={world}"])
        file = configured(robot, [f"sim.world={world}", "sim.seed=3", *settings_for(hardware, file, None)])
        self.file, self.names = file, [name for name in services_for(hardware, file) if name != "recorder"]
        services = {name: build_service(name, file, file.robot) for name in self.names}
        self.lockstep = Lockstep(services, record, wires(hardware, file))
        self.lockstep.run(1.0)

    def go(self, x: float, y: float, refused: str = "") -> None:
        """Sends the robot to a place; refused: the code with which that is refused instead."""
        task = Navigate(self.lockstep.now, (Pose2(x, y, 0.0),), 0.0, 1, True)
        assert self.lockstep.ask(requests.NAVIGATE, task).reason == refused

    def restart(self, name: str, after: float) -> None:
        self.lockstep.kill(name)
        self.lockstep.run(after)
        self.lockstep.start(name, build_service(name, self.file, self.file.robot))


def driving(run: ReferenceRun) -> None:
    """Around the table of a room."""
    run.go(3.2, 0.6)
    run.lockstep.run(SECONDS)


def exploring(run: ReferenceRun) -> None:
    """The first metres of an office."""
    assert run.lockstep.ask(requests.EXPLORE, Explore(run.lockstep.now)).accepted
    run.lockstep.run(SECONDS)


def person_crossing(run: ReferenceRun) -> None:
    """Somebody walks through before the robot."""
    run.go(4.5, 0.0)
    run.lockstep.run(SECONDS)


def goal_refused(run: ReferenceRun) -> None:
    """A goal in the table, to whose edge the robot drives; then one outside of all walls, which is refused."""
    run.go(2.1, -0.4)
    run.lockstep.run(2.5)
    run.go(30.0, 30.0, refused="goal_outside")
    run.lockstep.run(2.0)


def killed_service(run: ReferenceRun) -> None:
    """The mapper is killed while the robot drives and comes back; under STOP, guard and base_driver are."""
    run.go(3.2, 0.6)
    run.lockstep.run(2.7)
    run.restart("mapper", 0.5)
    run.lockstep.run(1.0)
    run.lockstep.publish(topics.ESTOP(EmergencyStop(run.lockstep.now, True, "test")))
    run.lockstep.run(0.33)
    for name in ("guard", "base_driver"):
        run.restart(name, 0.21)
    run.lockstep.run(0.5)


def swapped_laser(run: ReferenceRun) -> None:
    """Another laser, and board and laser behind ports that speak their bytes."""
    run.go(3.2, 0.6)
    run.lockstep.run(SECONDS)


SCENES: dict[str, tuple[Callable[[ReferenceRun], None], str, str, Hardware]] = {
    "driving": (driving, "room", "x80sv", Hardware.MESSAGES),
    "exploring": (exploring, "office", "x80sv", Hardware.MESSAGES),
    "person_crossing": (person_crossing, str(WORLDS / "crossing.yaml"), "x80sv", Hardware.MESSAGES),
    "goal_refused": (goal_refused, "room", "x80sv", Hardware.MESSAGES),
    "killed_service": (killed_service, "room", "x80sv", Hardware.MESSAGES),
    "swapped_laser": (swapped_laser, "room", "x80sv_xv11", Hardware.EMULATED),
}
"""By recording: what happens, in which world, to which robot, on what."""


def record(name: str, path: Path) -> None:
    """One of SCENES, into `path`."""
    happens, world, robot, hardware = SCENES[name]
    file = configured(robot, [])
    written: list[Sent] = []
    run = ReferenceRun(written.append, world, robot, hardware)
    happens(run)
    run.lockstep.flush()
    with Writer(path, about(file.robot.name), {CONFIG: run.file.text.encode()}) as writer:
        for sent in written:
            sink(writer)(sent)


def told(path: Path) -> Metrics:
    recording = Recording(path)
    lives = [life for of_name in recording.lives().values() for life in of_name]
    return {"size, kB": path.stat().st_size // 1000, **run_metrics(run_from_entries(recording.entries()), lives)}


def main(names: list[str]) -> None:
    for name in names or list(SCENES):
        path = path_of(name)
        before = told(path) if path.exists() else None
        path.parent.mkdir(exist_ok=True)
        record(name, path)
        now = told(path)
        changed = comparison_table(now if before is None else before, now, ("before", "now"), only_changed=True)
        state = "new" if before is None else "changed" if len(changed) > 1 else "as before"
        lines = [f"{name}: {state}, {now['size, kB']:g} kB", *(changed if len(changed) > 1 else ())]
        sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
