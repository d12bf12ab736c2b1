# SPDX-License-Identifier: Apache-2.0
"""Settings of the mapper."""

from typing import ClassVar

from pydantic import Field

from services.mapper.back_end.config import BackEndConfig
from services.mapper.back_end.loop_closure import LoopClosureConfig
from services.mapper.back_end.solver.optimize import PoseGraphConfig
from services.mapper.front_end.continuous_odometry import OdometryConfig
from services.mapper.front_end.correlative_match import SearchConfig
from services.mapper.front_end.front_end import FrontEndConfig
from services.mapper.front_end.registration import RegistrationConfig
from services.mapper.grid.occupancy import OccupancyConfig
from services.mapper.localization.global_localization import GlobalLocalizationConfig
from services.mapper.localization.kidnap_detection import KidnapConfig
from shared.config import Section


class MapperConfig(Section):
    """The mapper."""

    RENAMED: ClassVar[dict[str, str]] = {
        "loops": "loop_closure", "finding": "global_localization", "astray": "kidnap_detection",
        "unheld": "max_path_without_closure", "blind_doubt": "blind_sigma_scale",
    }  # fmt: skip

    registration: RegistrationConfig = RegistrationConfig()
    search: SearchConfig = SearchConfig()
    front_end: FrontEndConfig = FrontEndConfig()
    odometry: OdometryConfig = OdometryConfig()
    occupancy: OccupancyConfig = OccupancyConfig()
    back_end: BackEndConfig = BackEndConfig()
    loop_closure: LoopClosureConfig = LoopClosureConfig()
    pose_graph: PoseGraphConfig = PoseGraphConfig()
    global_localization: GlobalLocalizationConfig = GlobalLocalizationConfig()
    kidnap_detection: KidnapConfig = KidnapConfig()
    max_path_without_closure: float = Field(
        15.0, ge=1, le=10_000, description="m driven on a saved map without a closure, until the pose is poor"
    )
    blind_sigma_scale: float = Field(
        5.0, ge=1, le=100, description="factor of the prior's standard deviations without odometry"
    )
