# SPDX-License-Identifier: Apache-2.0
"""The preloaded parent of a stack's services: imports and kernels once, then one fork for each service.

It has one thread and no Zenoh session, ever. A fork copies only the thread that calls it, and a lock that another
thread holds stays locked in the copy. A service is forked twice, so that the launcher becomes its parent (it is a
subreaper while it asks). So a service does not depend on this process, and goes on when this process dies.

    launcher -> this process     JSON {"module", "arguments", "folder"}, with two descriptors: log, gate
    this process -> launcher     READY once; then b"PID" for each request

The new process waits at the gate, a pipe, until the launcher knows its number. Without that it ends.
"""

import shared.repeatable  # noqa: F401  # before numpy

# isort: split
import ctypes
import gc
import json
import logging
import os
import runpy
import signal
import socket
import sys
import threading
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

from zenav.stack.heap import fill_holes, limit_heap, release_free_memory
from zenav.stack.process_guard import die_with_parent

MODULE = "zenav.stack.fork_server"
READY = b"ready"
MAX_REQUEST = 2**17  # bytes: a command line; within the default size of a socket's buffer
PR_SET_NAME = 15
MADV_DONTNEED = 4
FOR_PRELOADING = {"sim": ["sim.world=empty"]}
"""Settings by service, with which its kernels are loaded: its own process builds the simulator's world."""
MAX_NAME_BYTES = 15  # of a process


def serve(connection: socket.socket, launcher: int) -> NoReturn:
    """Forks services on request until the connection ends. launcher: number of their parent process."""
    die_with_parent(launcher)
    os.setsid()  # a terminal's Ctrl-C is the launcher's affair
    _reset(connection.fileno())
    title(MODULE, [])
    try:
        connection.send(READY)
        while True:
            message, descriptors, _, _ = socket.recv_fds(connection, MAX_REQUEST, 2)
            if not message:
                os._exit(0)
            log, gate = descriptors
            pid = _forked(json.loads(message), connection.fileno(), launcher, log, gate)
            os.close(log)
            os.close(gate)
            connection.send(b"%d" % pid)
    except OSError:
        os._exit(0)  # the launcher is gone


def preload(commands: dict[str, list[str]]) -> bool:
    """Imports the services, and loads their inputs and kernels. What is wrong, they say themselves.

    commands: arguments by module, like `services.guard`. Returns whether this process may fork.
    """
    from shared.config import configured
    from shared.kernel_cache import warm_up
    from shared.runners import live  # noqa: F401  # Zenoh's library, without a session
    from shared.runners.service_start import PRELOADED, RobotSource, parser_of, read_robot, service_start
    from zenav.stack.service_loader import build_service, service_class

    robots: dict[tuple[str, ...], RobotSource] = {}  # by name and settings: the same for all services of a stack
    logging.disable(logging.CRITICAL)
    for module, arguments in commands.items():
        package, _, name = module.partition(".")
        if package != "services":
            continue
        try:
            options, unknown = parser_of(name).parse_known_args(arguments)
            if unknown:
                continue
            key = options.robot, *options.set
            robots[key] = robots.get(key) or read_robot(options)
            start = service_start(name, service_class(name), arguments, options, robots[key])
            settings = FOR_PRELOADING.get(name, [])
            file = configured(options.robot, [*options.set, *settings]) if settings else start.file
            warm_up(build_service(name, file, start.robot))
            PRELOADED[name] = start
        except (Exception, SystemExit):  # it ends the same way in its own process, with its words
            continue
    logging.disable(logging.NOTSET)
    share_pages()
    return is_single_threaded()


def share_pages() -> None:
    """Keeps memory shared with the processes that are forked from here on, and gives back what only loading needed."""
    release_free_memory()
    fill_holes()
    gc.freeze()  # a collection would write to each object that it visits
    unmap_clean_pages()


def unmap_clean_pages() -> None:
    """Drops the pages of libraries that were read and not changed; the next access brings them back from the file.

    Loading kernels reads 60 MB of LLVM, and nothing else does. A mapping with one changed page keeps all: those of
    relocated tables must not go.
    """
    madvise = ctypes.CDLL(None).madvise
    madvise.argtypes = (ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int)
    for begin, end in _clean_mappings(Path("/proc/self/smaps").read_text().splitlines()):
        madvise(begin, end - begin, MADV_DONTNEED)


def _clean_mappings(lines: list[str]) -> Iterator[tuple[int, int]]:
    """(begin, end) of the mappings of files that cannot be written and have no page of their own: man 5 proc, smaps."""
    place: tuple[int, int] | None = None
    for line in lines:
        key, *values = line.split()
        if not key.endswith(":"):
            begin, end = (int(number, 16) for number in key.split("-"))
            is_file = len(values) > 4 and values[4].startswith("/")
            place = (begin, end) if is_file and values[0] in ("r-xp", "r--p") else None
        elif key == "Anonymous:" and place is not None and int(values[0]) == 0:
            yield place


def is_single_threaded() -> bool:
    """Whether this process may fork: one thread for Python and for the system."""
    return threading.active_count() == 1 and len(os.listdir("/proc/self/task")) == 1


def _forked(request: dict[str, Any], connection: int, launcher: int, log: int, gate: int) -> int:
    """The number of a new process for a service; its parent is the launcher when this returns."""
    read_end, write_end = os.pipe()
    between = os.fork()
    if between == 0:
        pid = os.fork()
        if pid == 0:
            os.close(write_end)
            _become(request, launcher, log, gate)
        os.write(write_end, b"%d" % pid)
        os._exit(0)
    os.close(write_end)
    os.waitpid(between, 0)  # only now the new process has its new parent
    pid = int(os.read(read_end, 32))
    os.close(read_end)
    return pid


def _become(request: dict[str, Any], launcher: int, log: int, gate: int) -> NoReturn:
    """Runs a service's module as `python -m MODULE ARGUMENTS` does."""
    status = 1
    try:
        os.setsid()
        if os.read(gate, 1) != b"g":
            os._exit(1)  # the launcher does not know this process
        die_with_parent(launcher)
        nothing = os.open(os.devnull, os.O_RDONLY)
        for descriptor, place in ((nothing, 0), (log, 1), (log, 2)):
            os.dup2(descriptor, place)
        _reset()
        os.chdir(request["folder"])
        module, arguments = request["module"], request["arguments"]
        title(module, arguments)
        sys.argv[:] = [module, *arguments]
        runpy.run_module(module, run_name="__main__", alter_sys=True)
        status = 0
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def _reset(*kept: int) -> None:
    """Leaves nothing of the process that was forked: signals, descriptors but 0, 1, 2 and `kept`, streams, logging."""
    signal.set_wakeup_fd(-1)
    for number in (signal.SIGTERM, signal.SIGCHLD, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.pthread_sigmask(signal.SIG_SETMASK, ())
    low = 3
    for descriptor in sorted(kept):
        os.closerange(low, descriptor)
        low = descriptor + 1
    os.closerange(low, os.sysconf("SC_OPEN_MAX"))
    sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115  # as long as the process
    sys.stderr = open(2, "w", buffering=1, errors="backslashreplace", closefd=False)  # noqa: SIM115
    logging.getLogger().handlers.clear()


def title(module: str, arguments: list[str]) -> None:
    """Lets `ps` and `top` show a module and its arguments, as far as the process's own command line has room."""
    name = module.rpartition(".")[2].encode()[:MAX_NAME_BYTES]
    ctypes.CDLL(None).prctl(PR_SET_NAME, ctypes.create_string_buffer(name))
    fields = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
    begin, end = int(fields[45]), int(fields[46])  # arg_start and arg_end: man 5 proc
    if 0 < begin < end:
        text = "\0".join((module, *arguments)).encode()[: end - begin - 1]
        ctypes.memmove(begin, text.ljust(end - begin, b"\0"), end - begin)


def main() -> NoReturn:
    """The process of its own: `python -P -m zenav.stack.fork_server LAUNCHER_PID DESCRIPTOR COMMANDS`."""
    launcher, descriptor, commands = int(sys.argv[1]), int(sys.argv[2]), json.loads(sys.argv[3])
    die_with_parent(launcher)
    limit_heap()
    if not preload(commands):
        os._exit(3)  # the launcher starts the services without this process
    serve(socket.socket(fileno=descriptor), launcher)


if __name__ == "__main__":
    main()
