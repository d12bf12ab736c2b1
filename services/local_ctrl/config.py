# SPDX-License-Identifier: Apache-2.0
"""The settings of local control, and its controllers by name."""

from collections.abc import Callable
from typing import ClassVar, Literal

from pydantic import Field

from services.local_ctrl.controller import Controller
from services.local_ctrl.cost_to_go import CostToGoConfig
from services.local_ctrl.dwa import Dwa, DwaConfig
from services.local_ctrl.inputs import AgesConfig
from services.local_ctrl.local_costmap import CostmapConfig
from services.local_ctrl.manoeuvres import ManoeuvreConfig
from services.local_ctrl.mppi import Mppi, MppiConfig
from services.local_ctrl.path_following import PathFollowingConfig
from services.local_ctrl.pursuit import Pursuit, PursuitConfig
from services.local_ctrl.rollout import Limits
from shared.config import Section


class LocalCtrlConfig(Section):
    """Local control."""

    RENAMED: ClassVar[dict[str, str]] = {"distance_to_go": "cost_to_go", "follow": "path_following"}

    controller: Literal["mppi", "dwa", "pursuit"] = Field(
        "mppi", description="what follows the plan; docs/local_control.md compares them"
    )
    max_speed: float = Field(10.0, gt=0, le=10, description="m/s forward, where the drive allows more")
    max_reverse_speed: float = Field(
        0.15, ge=0, le=10, description="m/s backward, where the drive allows more; 0: never"
    )
    latency: float = Field(0.06, ge=0, le=0.5, description="s from sending a command until the base acts on it")
    speed_settling: float = Field(
        0.06, ge=0, le=1, description="s, time constant with which measured speed replaces commanded speed"
    )
    padding: float = Field(0.03, ge=0, le=0.5, description="m around the footprint that count as part of the robot")
    ages: AgesConfig = AgesConfig()
    costmap: CostmapConfig = CostmapConfig()
    cost_to_go: CostToGoConfig = CostToGoConfig()
    path_following: PathFollowingConfig = PathFollowingConfig()
    manoeuvres: ManoeuvreConfig = ManoeuvreConfig()
    mppi: MppiConfig = MppiConfig()
    dwa: DwaConfig = DwaConfig()
    pursuit: PursuitConfig = PursuitConfig()

    @property
    def tracked_costmap(self) -> CostmapConfig:
        """The costmap's settings, without the tracking of dynamic obstacles unless the controller uses predictions.

        A tracked obstacle is no part of the costmap, so another controller would drive into it.
        """
        if self.controller in PREDICTING:
            return self.costmap
        off = self.costmap.dynamic_obstacles.model_copy(update={"enabled": False})
        return self.costmap.model_copy(update={"dynamic_obstacles": off})


PREDICTING = {"mppi"}  # controllers that keep away from the predicted places of dynamic obstacles
CONTROLLERS: dict[str, Callable[[LocalCtrlConfig, Limits], Controller]] = {
    "mppi": lambda config, limits: Mppi(config.mppi, limits),
    "dwa": lambda config, limits: Dwa(config.dwa, limits),
    "pursuit": lambda config, limits: Pursuit(config.pursuit, limits),
}
"""Name in `local_ctrl.controller`: constructor."""
