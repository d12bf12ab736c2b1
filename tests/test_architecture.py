# SPDX-License-Identifier: Apache-2.0
"""The architecture as a test: which package may import, open, publish and read what. A failure has a hint."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from pydantic.fields import FieldInfo

from shared import messages, reasons, requests, topics
from shared.codec import fields_of
from shared.config import Robot, Section
from shared.messages import Message
from shared.runners.live_runner import URGENT
from shared.service import handlers
from zenav import docs
from zenav.console.setting_text import bounds_text
from zenav.stack.service_loader import existing_services, service_class

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("shared", "services", "zenav")
BUILT = tuple(existing_services())

FEEDBACK = {
    ("base_driver", "sim"): "the one way back: wheel speeds into the world",
    ("guard", "base_driver"): "the one way back: the velocity that the base obeys",
    ("planner", "navigator"): "the navigator sees whether there is a way, and how long",
    ("local_ctrl", "navigator"): "the navigator sees the progress, and when it has arrived",
    ("guard", "dashboard"): "the page shows the source of commands, and sees that STOP holds",
    ("guard", "uplink"): "the site's STOP is repeated until the guard confirms it",
    ("navigator", "uplink"): "a robot with a task sends the site more",
    ("guard", "navigator"): "the navigator reports why the robot stands",
    ("guard", "ros2"): "the reply to a ROS 2 node that presses STOP says whether it holds",
    ("base_driver", "ros2"): "the one way back: the velocity of a robot with ROS 2",
    ("traffic", "mapper"): "beams that end on other robots are no part of the map",
    ("traffic", "planner"): "a robot that makes way plans to its refuge; robots that stand are obstacles",
    ("traffic", "navigator"): "the navigator waits for other robots without a recovery",
    ("mapper", "ros2"): "the feedback of a ROS 2 action has the robot's pose",
    ("navigator", "ros2"): "a ROS 2 action follows the navigator's task",
}
"""(publisher, reader) against the flow, each with its reason. Nothing else may close a circle."""

LONG = {
    "shared/messages.py": "a table: every message",
}
"""Files over 400 lines, each with its reason."""

ZENOH = (
    "shared/runners/live_runner.py",
    "shared/runners/transport.py",
    "shared/runners/client.py",
    "shared/runners/waiting_topics.py",  # rings in Zenoh
    "services/gateway/router.py",  # a process of its own, which is no more than a session
    "services/ros2/wire.py",  # the session with ROS 2 nodes
    "services/uplink/site_session.py",  # the session with a site
    "shared/runners/presence.py",  # tokens of sessions
    "shared/runners/fleet_listener.py",  # sessions that hear every robot
    "zenav/",
)
FILES = (
    "port.py",
    "recording_store.py",
    "services/recorder/recording_files.py",  # parts of recordings
    "world_loader.py",
    "shared/recordings/",
    "shared/repeatable.py",
    "shared/config.py",
    "shared/robot_files.py",
    "shared/kernel_cache.py",  # the lock of a kernel's index
    "shared/ros_map.py",
    "shared/file_modes.py",
    "shared/secure_folder.py",  # keys and members
    "shared/credentials.py",  # what a member was given
    "shared/tls_server.py",  # copies of a certificate and its key
    "services/dashboard/certificate.py",
    "services/gateway/router.py",  # the names of its own threads
    "services/dashboard/login_store.py",
    "services/ros2/router_tls.py",  # certificates of the router
    "shared/runners/latched_disk.py",  # what a restart must not lose
    "shared/runners/checkpoint_disk.py",  # the same, where it is large
    "shared/runners/blackbox.py",  # what a crash must not lose
    "zenav/",
)
PUBLIC_API = "zenav/client/__init__.py"  # what users' programs import
OPENING = {"open", "read_text", "read_bytes", "write_text", "write_bytes", "mkdir", "unlink", "rename", "touch"}


def rule(holds: object, what: str, hint: str) -> None:
    """Fails with two lines, what is wrong and its hint, where the rule does not hold."""
    if not holds:
        pytest.fail(f"{what}\nhint: {hint}", pytrace=False)


@cache
def nodes(path: Path) -> tuple[ast.AST, ...]:
    """All that a file consists of."""
    return tuple(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))


def files(*packages: str) -> list[Path]:
    return sorted(path for package in packages or PACKAGES for path in (ROOT / package).rglob("*.py"))


def short(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def module(path: Path) -> str:
    return short(path).removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def imported(path: Path) -> Iterator[str]:
    """Every module, or name in a module, that a file imports, wherever in the file."""
    for node in nodes(path):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            rule(node.level == 0, f"{short(path)}:{node.lineno} imports relatively", "write the whole name")
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def owner(path: Path) -> str:
    """services.mapper, shared.grid, shared.runners, zenav: what a file belongs to."""
    parts = module(path).split(".")
    return parts[0] if parts[0] == "zenav" else ".".join(parts[:2])


def edges() -> set[tuple[str, str]]:
    """(publisher, reader) among the services that are built, from the registry and the handlers."""
    return {
        (publisher, reader)
        for reader in BUILT
        for topic, _ in handlers(service_class(reader)).topics.values()
        for publisher in topic.publishers
        if publisher in BUILT and publisher != reader and topic.by != "*"  # a family is for people, or a service's own
    }


def test_every_folder_of_services_is_in_the_registry():
    folders = {path.name for path in (ROOT / "services").iterdir() if (path / "service.py").exists()}
    rule(
        folders <= set(topics.SERVICES),
        f"not in the registry: {sorted(folders - set(topics.SERVICES))}",
        "add it to SERVICES in shared/topics.py",
    )


def test_services_never_import_each_other_and_shared_imports_neither_them_nor_zenav():
    for path in files("services", "shared"):
        for name in imported(path):
            if name.startswith(("services.", "zenav.")):
                rule(
                    name.startswith(owner(path) + "."),
                    f"{short(path)} imports {name}",
                    "move what both need to shared/, or send it as a message",
                )


def test_no_service_listens_to_a_stream_that_it_may_publish_itself():
    for name in BUILT:
        for topic, _ in handlers(service_class(name)).topics.values():
            from_outside = topic.by == "*" or bool(topic.from_robots)
            deaf = name in topic.publishers and not from_outside and not topic.latched
            rule(
                not deaf, f"{name} listens to {topic.key} and may publish it: live, it gets nothing", "take two topics"
            )


@pytest.mark.parametrize("name", BUILT)
def test_only_streams_wait_for_the_next_event_of_a_service(name):
    found = handlers(service_class(name))
    for key in found.waiting:
        topic = found.topics[key][0]
        is_stream = topic.by != "*" and topic.hz >= 10 and not (topic.latched or topic.from_robots or key in URGENT)
        rule(is_stream, f"{name}: {key} waits", "leave out waits=True: a kept or an urgent message is handled at once")


def circle_in(graph: set[tuple[str, str]]) -> str:
    """A circle of (publisher, reader) edges, as words; empty where there is none."""
    readers: dict[str, set[str]] = {name: set() for name in BUILT}
    for publisher, reader in graph:
        readers[publisher].add(reader)
    try:
        TopologicalSorter(readers).prepare()
    except CycleError as circle:
        return " <- ".join(circle.args[1])
    return ""


def test_data_flows_one_way():
    circle = circle_in(edges() - set(FEEDBACK))
    rule(not circle, f"messages run in a circle: {circle}", "break it, or give FEEDBACK an edge with its reason")


@pytest.mark.parametrize("edge", FEEDBACK, ids=" to ".join)
def test_every_feedback_edge_is_there_and_needed(edge):
    rule(edge in edges(), f"FEEDBACK has {edge}, but no message goes that way", "remove the entry")
    rule(circle_in((edges() - set(FEEDBACK)) | {edge}), f"{edge} closes no circle", "remove it from FEEDBACK")


@pytest.mark.parametrize("topic", topics.TOPICS, ids=lambda topic: topic.key)
def test_every_topic_has_a_publisher_and_a_reader_or_is_for_people(topic):
    strangers = set(topic.publishers) - set(topics.SERVICES) - {"operator"}
    rule(not strangers, f"{topic.key} is published by {strangers}", "name services of shared/topics.py")
    if topic.by != "*":
        name = next(name for name, value in vars(topics).items() if value is topic)
        publishers = [p for p in topic.publishers if p in BUILT]
        talking = [p for p in publishers if any(name in constants(f, "topics") for f in files(f"services/{p}"))]
        by_people = "operator" in topic.publishers and any(name in constants(f, "topics") for f in files("zenav"))
        rule(talking or by_people, f"nobody publishes {topic.key}", f"yield topics.{name}(...), or remove it")
    readers = [name for name in BUILT if topic.key in handlers(service_class(name)).topics]
    rule(
        readers or topic.people,
        f"no service reads {topic.key}",
        "remove it, or mark it people=True in shared/topics.py",
    )


@pytest.mark.parametrize("request_", requests.REQUESTS, ids=lambda request: request.key)
def test_every_request_is_answered_by_the_service_that_the_registry_names(request_):
    answering = [name for name in BUILT if request_.key in handlers(service_class(name)).requests]
    rule(
        answering == (list(BUILT) if request_.by == "*" else [request_.by]),
        f"{request_.key} is answered by {answering}, not by {request_.by}",
        "@answer it there, once",
    )


def test_every_module_of_shared_has_two_users():
    users: dict[str, set[str]] = {owner(p): set() for p in files("shared") if p.name != "__init__.py"}
    for path in files():
        for name in imported(path):
            used = ".".join(name.split(".")[:2])
            if used in users and used != owner(path):
                users[used].add(owner(path))
    lonely = {name: sorted(by) for name, by in users.items() if len(by) < 2}
    rule(not lonely, f"used by fewer than two: {lonely}", "move it into the one that uses it, or remove it")


def constants(path: Path, table: str) -> set[str]:
    """The names of a table of `shared` that a file uses: `reasons.BLOCKED`, or BLOCKED imported from it."""
    found = {name.rpartition(".")[2] for name in imported(path) if name.startswith(f"shared.{table}.")}
    for node in nodes(path):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == table:
            found.add(node.attr)
    return found


def test_every_reason_has_its_words_and_is_used():
    rows = {name: row for name, row in vars(reasons).items() if isinstance(row, reasons.Reason)}
    used = {name for path in files() for name in constants(path, "reasons")}
    mute = [name for name, row in rows.items() if not (row.text and row.hint)]
    rule(not mute, f"without text or hint: {mute}", "say why the robot stands and what to do, in shared/reasons.py")
    idle = sorted(set(rows) - used)
    rule(not idle, f"nothing ever stands for these reasons: {idle}", "use them, or remove their rows")


def test_every_field_of_every_message_has_its_unit():
    for class_ in every_subclass(Message):
        if class_.__module__ in (messages.__name__, requests.__name__):
            for field in fields_of(class_):
                rule(field.unit, f"{class_.__name__}.{field.name} has no unit", 'annotate it with Unit("m")')


def every_subclass(class_: type) -> Iterator[type]:
    for child in class_.__subclasses__():
        yield child
        yield from every_subclass(child)


@pytest.mark.parametrize("name", ["robot", *BUILT])
def test_every_setting_says_what_it_is_and_in_which_bounds(name):
    model = Robot if name == "robot" else service_class(name).config_type
    for key, field in docs.settings(model):
        if isinstance(field.annotation, type) and issubclass(field.annotation, Section):
            continue
        rule(
            field.description or is_of_sections(field),
            f"{name}.{key} has no description",
            "Field(..., description='m ahead of the axis'), the unit first",
        )
        if field.annotation in (int, float):
            rule(bounds_text(field), f"{name}.{key} has no bounds", "Field(..., ge=..., le=...)")


def is_of_sections(field: FieldInfo) -> bool:
    return docs.section_of(field) is not None


def test_only_the_transport_and_zenav_speak_zenoh():
    for path in files():
        if not short(path).startswith(ZENOH):
            speaks = [name for name in imported(path) if name.split(".")[0] == "zenoh"]
            rule(not speaks, f"{short(path)} imports zenoh", "publish by yielding; the live runner sends it")


def test_no_service_but_the_simulator_uses_scipy():
    for path in files("shared", "services"):
        uses = {name for name in imported(path) if name.split(".")[0] == "scipy"}
        allowed = {"scipy"} if short(path).startswith("services/sim/") else set()
        rule(
            uses <= allowed,
            f"{short(path)} imports {uses - allowed}",
            "use numpy: scipy costs a stack 12 MB; the simulator writes `import scipy`, whose parts load late",
        )


def test_only_the_shell_of_the_page_loads_a_web_library():
    shell = (
        *(f"services/dashboard/web_{name}.py" for name in ("app", "login", "server")),
        "zenav/bench/hostile_clients.py",  # a process of its own
    )
    for path in files():
        if not short(path).startswith(shell):
            loads = {name.split(".")[0] for name in imported(path)} & {"starlette", "uvicorn", "websockets", "anyio"}
            rule(not loads, f"{short(path)} imports {loads}", "pass it on to the shell, which is loaded with a browser")


def test_only_the_files_that_own_it_open_files():
    for path in files():
        if short(path).startswith(FILES) or path.name in FILES:
            continue
        for node in nodes(path):
            if not isinstance(node, ast.Call):
                continue
            called = node.func
            name = called.attr if isinstance(called, ast.Attribute) else getattr(called, "id", "")
            on = called.value if isinstance(called, ast.Attribute) else None
            on_sink = isinstance(on, ast.Attribute) and isinstance(on.value, ast.Name) and on.value.id == "self"
            on_zenoh = isinstance(on, ast.Name) and on.id == "zenoh"
            rule(
                name not in OPENING or on_sink or on_zenoh,
                f"{short(path)}:{node.lineno} calls {name}",
                "files are opened in port.py, recording_store.py, world_loader.py and zenav only",
            )


def test_a_process_is_a_few_lines_and_a_package_none():
    for path in files("services"):
        lines = len(path.read_text(encoding="utf-8").splitlines())
        if path.name == "__main__.py":
            rule(lines <= 15, f"{short(path)} has {lines} lines", "logic belongs to service.py and its algorithms")
    for path in files():
        if path.name == "__init__.py" and short(path) != PUBLIC_API:
            rule(not path.read_bytes(), f"{short(path)} is not empty", "give its content a file with a name")


@pytest.mark.parametrize("name", BUILT)
def test_every_service_is_a_process(name):
    main = ROOT / "services" / name / "__main__.py"
    rule(main.exists(), f"services/{name} has no __main__.py", "see docs/new_service.md")
    start = f"live.main({service_class(name).__name__}"
    rule(start in main.read_text(encoding="utf-8"), f"{short(main)} does not start its service", f"{start})")


def test_a_file_answers_one_question():
    for path in files():
        lines = len(path.read_text(encoding="utf-8").splitlines())
        limit = 10**6 if short(path) in LONG else 400
        if path.name == "service.py" and path.parent.parent.name == "services":
            limit = 250  # read in one sitting
        rule(lines <= limit, f"{short(path)} has {lines} lines", "it answers two questions: give each its file")


def test_every_file_begins_with_its_licence():
    for path in files(*PACKAGES, "tests"):
        text = path.read_text(encoding="utf-8")
        rule(
            not text or text.startswith("# SPDX-License-Identifier: Apache-2.0\n"),
            f"{short(path)} begins otherwise",
            "# SPDX-License-Identifier: Apache-2.0",
        )


@pytest.mark.parametrize("page", docs.PAGES)
def test_generated_docs_are_fresh(page):
    written = (ROOT / "docs" / page).read_text(encoding="utf-8")
    rule(written == docs.PAGES[page](), f"docs/{page} is not what the code says", "make docs")


def test_only_the_kiss_registrar_loads_its_package():
    code = "import sys, services.mapper.service; sys.stdout.write(' '.join(sys.modules))"
    loaded = set(subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True).stdout.split())
    rule("services.mapper.front_end.registration" in loaded, "the mapper is not where it was", "adapt this test")
    rule("kiss_icp" not in loaded, "the mapper loads kiss_icp", "import it where KissRegistrar is made")


@pytest.mark.parametrize("command", ["zenav", "zenav.stack.service_loader"])
def test_importing_the_command_line_loads_nothing_heavy(command):
    heavy = {"zenoh", "numba", "scipy", "kiss_icp"}
    code = f"import sys, {command}; sys.stdout.write(' '.join(sys.modules))"
    loaded = set(subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True).stdout.split())
    rule(not loaded & heavy, f"{command} loads {loaded & heavy}", "import late, where the work is done")


@pytest.mark.parametrize("root", ["services", "shared", "zenav"])
def test_constructors_with_over_five_arguments_are_called_with_keywords(root):
    found = []
    for path in sorted((ROOT / root).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            name = getattr(node.func, "id", getattr(node.func, "attr", "")) if isinstance(node, ast.Call) else ""
            if name[:1].isupper() and len(node.args) > 5:
                found.append(f"{path.relative_to(ROOT)}:{node.lineno}: {name} with {len(node.args)} arguments")
    assert not found, "\n".join(found)
