# SPDX-License-Identifier: Apache-2.0
"""The settings of the page's server."""

from typing import Literal

from pydantic import Field, model_validator

from shared.config import Section
from shared.ports import PortConfig


class DashboardConfig(Section):
    """The page."""

    port: PortConfig = Field(
        PortConfig(device="web://127.0.0.1"),
        description="web://HOST:PORT; without PORT: 8600 + the stack's number; an address for other computers, as "
        "web://0.0.0.0, needs a certificate: zenav secure init",
    )
    login: Literal["remote", "always"] = Field(
        "remote", description="which pages must log in: those of other computers, or all (behind a reverse proxy)"
    )
    certificate: str = Field(
        "", description="PEM file with the page's certificate and those above it; empty: robot.pem of the secure folder"
    )
    key: str = Field("", description="PEM file with the key of `certificate`")
    hosts: tuple[str, ...] = Field(
        (), description="names and addresses by which browsers may reach the page, besides those of the certificate"
    )
    fleet: bool = Field(
        False, description="a page of a site: it shows each robot of its router, one at a time, and has none of its own"
    )
    tools: str = Field(
        "zenav.page.tools",
        pattern=r"^([a-z_]+(\.[a-z_]+)*)?$",
        description="module of the process that works on maps, places, recordings and settings for pages; empty: none",
    )

    @model_validator(mode="after")
    def _check_pair(self) -> "DashboardConfig":
        if bool(self.certificate) != bool(self.key):
            raise ValueError("`certificate` and `key` belong together: give both")
        return self
