# SPDX-License-Identifier: Apache-2.0
"""Services and topics of users' packages. ZENAV_WITH names the packages; they name the rest by entry points:

    [project.entry-points."zenav.services"]
    mileage = "mypackage.mileage"              # its service.py has the Service, its __main__.py runs it

    [project.entry-points."zenav.topics"]
    mypackage = "mypackage.topics"             # each Topic in it is a row of the registry

A module of topics imports nothing but shared.messages and shared.topics: the registry imports it.
"""

import os
from functools import cache
from typing import TYPE_CHECKING

from shared.user_error import UserError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

VARIABLE = "ZENAV_WITH"
SERVICES_GROUP, TOPICS_GROUP = "zenav.services", "zenav.topics"


def packages() -> tuple[str, ...]:
    """The packages of ZENAV_WITH, separated by commas."""
    given = os.environ.get(VARIABLE, "")  # noqa: TID251  # each process of a stack has the same registry
    return tuple(name for name in given.split(",") if name)


@cache
def extension_services(names: tuple[str, ...]) -> dict[str, str]:
    """The module of each service of these packages by its name, in their order.

    Raises UserError where a package is not installed or has no service, or two have one name.
    """
    found: dict[str, str] = {}
    for package in names:
        points = _entry_points(package, SERVICES_GROUP)
        if not points:
            raise UserError(
                f"the package {package} has no services for zenav",
                f"name them in its entry points, group {SERVICES_GROUP}: docs/new_service.md",
            )
        for point in points:
            if point.name in found:
                raise UserError(f"two packages have a service {point.name}", "leave one of them out")
            found[point.name] = point.value
    return found


def topic_modules(names: tuple[str, ...]) -> list[str]:
    """The modules with the topics of these packages. Raises UserError where a package is not installed."""
    return [point.value for package in names for point in _entry_points(package, TOPICS_GROUP)]


def service_module(name: str) -> str:
    """The module of a service: `services.NAME`, or that of a package."""
    return extension_services(packages()).get(name, f"services.{name}")


def service_name(module: str) -> str:
    """The name of the service in `MODULE.service`: as its package gives it, else the folder's."""
    folder = module.removesuffix(".service")
    named = {value: name for name, value in extension_services(packages()).items()}
    return named.get(folder, folder.rpartition(".")[2])


def _entry_points(package: str, group: str) -> "list[EntryPoint]":
    from importlib.metadata import PackageNotFoundError, distribution  # 20 ms, which most processes do not need

    try:
        found = distribution(package).entry_points
    except (PackageNotFoundError, ValueError):
        raise UserError(f"no package {package} is installed", f"pip install {package}, beside zenav") from None
    return sorted(found.select(group=group), key=lambda point: point.name)
