# SPDX-License-Identifier: Apache-2.0
"""Settings of traffic."""

from pydantic import Field

from shared.config import Section


class TrafficConfig(Section):
    """The right of way among robots on one map."""

    priority: int = Field(0, ge=0, le=9, description="1: the robot with the higher one goes first")
    beside: float = Field(
        0.25, ge=0.05, le=2, description="m between the outlines of two robots whose paths may be driven at once"
    )
    passing: float = Field(
        0.2, ge=0, le=2, description="m beside and between two robots that pass each other; else the passage is narrow"
    )
    reach: float = Field(3.0, ge=1, le=20, description="m of free way ahead that the robot asks for in time")
