# SPDX-License-Identifier: Apache-2.0
"""Settings of the navigator."""

from collections import Counter

from pydantic import Field, model_validator

from services.navigator.exploration import ExplorationConfig
from services.navigator.goal_attempt import GoalAttemptConfig
from services.navigator.recovery import RecoveryConfig
from shared.config import Section
from shared.messages import MAX_ZONES
from shared.zones import NamedZoneConfig


class NavigatorConfig(Section):
    """The navigator."""

    tolerance: float = Field(0.15, ge=0.01, le=5, description="m to the goal at which it is reached")
    yaw_tolerance: float = Field(0.25, ge=0.01, le=3.14, description="rad to the goal's heading at which it is reached")
    pass_within: float = Field(
        0.7,
        ge=0.01,
        le=10,
        description="m of path to a pose that is passed through, at which the next one follows",
    )
    zones: tuple[NamedZoneConfig, ...] = Field(
        (), max_length=MAX_ZONES, description="keep-out and speed zones on every map; those of one map: zenav zones"
    )
    lost_time: float = Field(
        2.0, ge=0, le=60, description="s for which the pose may be lost until the robot is stopped"
    )
    resume_within: float = Field(
        10.0,
        ge=0,
        le=30,
        description="s that a restart of the navigator may take for its task to continue; a hang lasts over 5",
    )
    leg: GoalAttemptConfig = GoalAttemptConfig()
    recovery: RecoveryConfig = RecoveryConfig()
    exploration: ExplorationConfig = ExplorationConfig()

    @model_validator(mode="after")
    def _has_zones_of_different_names(self) -> "NavigatorConfig":
        if twice := [name for name, n in Counter(zone.name for zone in self.zones).items() if n > 1]:
            raise ValueError(f"two zones of one name: {', '.join(twice)}")
        return self
