# SPDX-License-Identifier: Apache-2.0
"""The settings of the link to a site."""

from pydantic import Field

from shared.config import Section
from shared.ports import PortConfig


class UplinkConfig(Section):
    """The link to a site."""

    port: PortConfig = Field(
        PortConfig(), description="tls://HOST:7449, the router of the site; without a device: no link"
    )
    credentials: str = Field(
        "", description="file of `zenav secure add NAME --role robot`; empty: ZENAV_CREDENTIALS, or that of the host"
    )
    max_order_age: float = Field(5.0, ge=1, le=60, description="s; an older order of the site is refused, but for STOP")
    recording_rate: float = Field(
        50.0, ge=1, le=100_000, description="kB/s at most of recordings that the site fetches: they share the link"
    )
