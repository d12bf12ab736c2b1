# SPDX-License-Identifier: Apache-2.0
"""Settings of the back end."""

from typing import ClassVar

from pydantic import Field

from services.mapper.back_end.pairwise_constraints import PairwiseConfig
from shared.config import Section


class BackEndConfig(Section):
    """The back end: keyframes, when the graph is optimized, and the local map."""

    RENAMED: ClassVar[dict[str, str]] = {
        "noise": "min_sigma", "noise_turn": "min_sigma_turn", "off": "urgent_error", "off_turn": "urgent_turn_error",
        "patience": "max_pending_closures", "tied": "max_pending_pairwise", "redraw": "redraw_interval",
        "crowd": "max_keyframes_per_place", "crowd_reach": "place_size", "sure": "max_local_sigma",
        "near": "local_radius", "renew": "local_map_interval", "recent": "max_localization_keyframes",
        "ties": "pairwise",
    }  # fmt: skip

    min_sigma: float = Field(
        0.01, ge=0.001, le=1, description="m, minimum standard deviation from a keyframe to the next"
    )
    min_sigma_turn: float = Field(0.003, ge=0.0003, le=1, description="rad, the same for the turn")
    urgent_error: float = Field(
        0.05, ge=0, le=10, description="m, error of a closure from which the graph is optimized at once"
    )
    urgent_turn_error: float = Field(0.02, ge=0, le=3, description="rad, the same for its turn")
    max_pending_closures: int = Field(
        20, ge=1, le=10_000, description="consistent closures from which the graph is optimized"
    )
    max_pending_pairwise: int = Field(
        360, ge=1, le=10_000, description="pairwise constraints from which the graph is optimized"
    )
    redraw_interval: float = Field(2.0, ge=0, le=3600, description="s, minimum pause between two redrawings of the map")
    max_keyframes_per_place: int = Field(
        6, ge=2, le=1000, description="keyframes at one place from which the oldest is removed"
    )
    place_size: float = Field(
        0.5, ge=0.05, le=5, description="m in x and y, and rad in yaw, within which keyframes count as one place"
    )
    max_local_sigma: float = Field(
        0.2, ge=0.01, le=10, description="m, maximum standard deviation from the newest keyframe, in the local map"
    )
    local_radius: float = Field(10.0, ge=1, le=250, description="m, radius about the robot of the local map")
    local_map_interval: int = Field(20, ge=1, le=10_000, description="keyframes between two checks of the local map")
    max_localization_keyframes: int = Field(
        60, ge=2, le=10_000, description="newest keyframes that are placed together on a map that does not change"
    )
    pairwise: PairwiseConfig = PairwiseConfig()
