# SPDX-License-Identifier: Apache-2.0
"""The settings of a running stack: what holds, and changes of several at once, all or none."""

import json
from collections.abc import Iterable, Mapping
from contextlib import suppress
from typing import Any, NamedTuple

from shared import requests
from shared.config import RobotFile, Section, UserError, nearest
from shared.requests import SetSettings, SettingsReply
from shared.settings import (
    BY_NAME,
    RUN_TIME,
    RUNTIME_SETTINGS,
    RuntimeSetting,
    field_at,
    put_runtime_value,
    without_origin,
)
from zenav.client import Client
from zenav.stack.config_report import read_sections, section_models, setting_values

ASK_S = 3.0  # s that a service has for its reply: it may compute a costmap of a large map meanwhile


class HeldSetting(NamedTuple):
    """The value of a setting in a running service, and the one with which the service was started."""

    value: Any
    started: Any


class RunningSettings:
    """The settings of a stack that may change while it runs. file: the robot's."""

    def __init__(self, client: Client, file: RobotFile) -> None:
        self._client, self._file = client, file

    def held(self, rows: Iterable[RuntimeSetting] = RUNTIME_SETTINGS) -> dict[str, HeldSetting]:
        """By name what holds, of the services that run. Where several take a setting, the first counts."""
        found: dict[str, HeldSetting] = {}
        for service in dict.fromkeys(service for row in rows for service in row.services):
            with suppress(UserError):
                found = _held_in(self._ask(service)) | found
        return found

    def change(self, changes: Mapping[str, str]) -> list[str]:
        """Sets these settings (name -> YAML; empty: as started), all or none. Returns `name = value (was value)`.

        Raises UserError where a name or a value is wrong, a service refuses it, or does not run.
        """
        rows = [self.row(name) for name in changes]
        services = dict.fromkeys(service for row in rows for service in row.services)
        before = {service: _held_in(self._ask(service)) for service in services}
        self._check_by_models(rows, changes, before)
        orders = {
            service: {row.name: changes[row.name] for row in rows if service in row.services} for service in services
        }
        for service, values in orders.items():
            self._ask(service, values, check=True)
        after: dict[str, dict[str, HeldSetting]] = {}
        try:
            for service, values in orders.items():
                after[service] = {}  # where its reply is lost it may have changed, too
                after[service] = _held_in(self._ask(service, values))
        except UserError:
            self._put_back(orders, {service: before[service] for service in after})
            raise
        texts = []
        for row in rows:
            was, now = before[row.services[0]][row.name].value, after[row.services[0]][row.name].value
            texts.append(f"{row.name} = {json.dumps(now)} (was {json.dumps(was)})")
        return texts

    def row(self, name: str) -> RuntimeSetting:
        """The row of a name. Raises UserError where it is no setting, or none that changes at run time."""
        if name in BY_NAME:
            return BY_NAME[name]
        every = tuple(".".join(path) for path, _ in setting_values(read_sections(self._file)))
        if name in every:
            hint = f"put it into {self._file.path}, or start again with --set {name}=VALUE"
            raise UserError(f"{name} needs a restart", hint)
        raise UserError(f"{name} is not a setting", nearest(name, every))

    def text_with_present_values(self) -> str:
        """The robot's file as YAML, with what differs from it in the running stack. Raises UserError."""
        sections = read_sections(self._file)
        values = {".".join(path): value for path, value in setting_values(sections)}
        for name, held in self.held().items():
            if held.value != values[name]:
                self._file.put(BY_NAME[name].path, held.value, RUN_TIME)
        return self._file.text

    def _ask(self, service: str, values: Mapping[str, str] | None = None, check: bool = False) -> SettingsReply:
        """The reply of a service; without values it changes nothing. Raises UserError where it refuses."""
        values = values or {}
        request = SetSettings(self._client.now(), tuple(values), tuple(values.values()), check)
        reply = self._client.ask(requests.SET, request, ASK_S, service)
        if not reply.accepted:
            raise UserError(f"{service}: {reply.detail}", reply.hint)
        return reply

    def _check_by_models(
        self, rows: list[RuntimeSetting], changes: Mapping[str, str], before: dict[str, dict[str, HeldSetting]]
    ) -> None:
        """Validates the robot's file with what holds and the changes, before any service is asked to change."""
        values = {name: json.dumps(held.value) for service in before.values() for name, held in service.items()}
        started = {name: json.dumps(held.started) for service in before.values() for name, held in service.items()}
        values |= {row.name: changes[row.name] or started[row.name] for row in rows}
        for name, text in values.items():
            put_runtime_value(self._file, BY_NAME[name], text)
        sections = tuple(dict.fromkeys(row.path[0] for row in rows))
        try:
            for section, model in section_models(sections).items():
                self._file.section(section, model)
        except UserError as error:
            raise without_origin(error) from None

    def _put_back(self, orders: dict[str, dict[str, str]], before: dict[str, dict[str, HeldSetting]]) -> None:
        """Gives services their former values after one failed. One that has ended cannot take them."""
        for service, held in before.items():
            former = {name: held[name] for name in orders[service]}
            values = {name: "" if h.value == h.started else json.dumps(h.value) for name, h in former.items()}
            with suppress(UserError):
                self._ask(service, values)


def runtime_models() -> dict[str, type[Section]]:
    """Section -> model, of the sections with settings that may change at run time."""
    return section_models(tuple(dict.fromkeys(row.path[0] for row in RUNTIME_SETTINGS)))


def description_of(row: RuntimeSetting, models: Mapping[str, type[Section]]) -> str:
    """What a setting is, its unit first."""
    return field_at(models[row.path[0]], row.path[1:]).description or ""


def _held_in(reply: SettingsReply) -> dict[str, HeldSetting]:
    rows = zip(reply.names, reply.values, reply.started, strict=True)
    return {name: HeldSetting(json.loads(value), json.loads(started)) for name, value, started in rows}
