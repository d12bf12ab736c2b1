# SPDX-License-Identifier: Apache-2.0
"""The service classes by name: what lies at `services/NAME/service.py`, or in a user's package."""

import inspect
from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec

from shared.config import Robot, RobotFile
from shared.extensions import service_module
from shared.service import Service
from shared.topics import SERVICES


def existing_services() -> Iterator[str]:
    """The registry's services that exist here, in its order."""
    modules = {name: service_module(name) for name in SERVICES}
    return (name for name, module in modules.items() if find_spec(module) and find_spec(f"{module}.service"))


def service_class(name: str) -> type[Service]:
    """The one Service of its `service.py`."""
    module = import_module(f"{service_module(name)}.service")
    found = [
        value
        for value in vars(module).values()
        if inspect.isclass(value) and issubclass(value, Service) and value.__module__ == module.__name__
    ]
    if len(found) != 1:
        raise TypeError(f"{module.__name__} defines {len(found)} services, not one")
    return found[0]


def build_service(name: str, file: RobotFile, robot: Robot) -> Service:
    """The service with its section of a robot's file. Its sinks, if it has any, lead nowhere."""
    class_ = service_class(name)
    sinks = list(inspect.signature(class_.__init__).parameters)[3:]
    return class_(file.section(name, class_.config_type), robot, **dict.fromkeys(sinks, _Nowhere()))


class _Nowhere:
    """A sink that takes everything and keeps nothing: each of its methods and values is empty."""

    def __call__(self, *_: object) -> tuple[()]:
        return ()

    def __getattr__(self, name: str) -> "_Nowhere":
        return self

    def __bool__(self) -> bool:
        return False
