# SPDX-License-Identifier: Apache-2.0
"""The process of one service.

It ends within half a second on SIGINT and SIGTERM. An exception ends it with the traceback and status 1.
"""

import gc
import logging
import os
import signal
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from shared.config import UserError
from shared.extensions import service_name
from shared.kernel_cache import warm_up
from shared.runners import transport
from shared.runners.blackbox import BlackBox
from shared.runners.clock import clock_from
from shared.runners.devices import NO_DEVICES, Devices, device_opener
from shared.runners.latched_disk import LatchedDisk
from shared.runners.live_runner import LiveRunner
from shared.runners.service_start import PRELOADED, ServiceStart, parser_of, service_start
from shared.service import Service

VELOCITY_PATH = ("base_driver", "odometry", "local_ctrl", "guard")

log = logging.getLogger("zenav")


def main(service_class: type[Service], devices: Devices = NO_DEVICES, **sinks: Callable[[Any], Any]) -> None:
    """The whole process of one service. A sink is built from the service's configuration and passed by name.

    devices: by kind, like `web` of web://127.0.0.1, the devices that the service brings for its ports.
    """
    name = service_name(service_class.__module__)
    preloaded = PRELOADED.get(name)
    start = preloaded if preloaded is not None and preloaded.is_of(tuple(sys.argv[1:])) else None
    options = start.options if start is not None else parser_of(name).parse_args()
    logging.basicConfig(level=options.log, stream=sys.stderr, format=f"%(asctime)s {name} %(levelname)s %(message)s")
    status = 1
    try:
        if start is None:
            start = service_start(name, service_class, sys.argv[1:], options)
        _serve(service_class, name, start, devices, sinks)
        status = 0
    except UserError as error:
        sys.stderr.write(f"{name}: {error.what}\nhint: {error.hint}\n")
        status = 2
    except KeyboardInterrupt:
        status = 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)  # Zenoh's callback threads are not daemons: a plain return could hang


def _serve(
    service_class: type[Service], name: str, start: ServiceStart, devices: Devices, sinks: dict[str, Any]
) -> None:
    options, config, robot = start.options, start.config, start.robot
    where, clock = transport.stack_address(options.stack), clock_from(options.clock)
    opened = {key: sink(config) for key, sink in sinks.items()}
    service = service_class(config, robot, **opened)
    if hasattr(service, "robot_file"):
        service.robot_file = start.robot_file
    if name not in PRELOADED:
        warm_up(service)
    if name in VELOCITY_PATH and not transport.asks_for_realtime():
        log.info("no real-time priority (SCHED_RR) here: latency depends on other load")
    gc.collect()
    gc.freeze()
    sys.setswitchinterval(0.0005)
    transport.receives_on_one_thread()
    with transport.opened(where, name, everything=hasattr(service, "raw")) as session:
        disk = LatchedDisk(Path(options.memory), name) if options.memory else None
        box = None if hasattr(service, "raw") else BlackBox(Path(options.crashes), name, robot.name, start.robot_file)
        open_device = device_opener(devices, config, robot.name, where, options)
        runner = LiveRunner(
            service=service,
            name=name,
            robot=robot.name,
            session=session,
            clock=clock,
            disk=disk,
            box=box,
            open_device=open_device,
        )
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: runner.stop())
        log.info("started")
        runner.run()
    for sink in opened.values():
        if hasattr(sink, "close"):
            sink.close()
    log.info("stopped")
