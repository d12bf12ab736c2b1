# SPDX-License-Identifier: Apache-2.0
"""Settings of the guard."""

from services.guard.arbitration import ArbitrationConfig
from services.guard.contact_stop import ContactStopConfig
from services.guard.laser_visibility import VisibilityConfig
from services.guard.obstacles import ObstaclesConfig
from services.guard.protective_field import FieldConfig
from services.guard.stop_conditions import StopConditionsConfig
from shared.config import Section


class GuardConfig(Section):
    """The guard."""

    stops: StopConditionsConfig = StopConditionsConfig()
    arbitration: ArbitrationConfig = ArbitrationConfig()
    field: FieldConfig = FieldConfig()
    obstacles: ObstaclesConfig = ObstaclesConfig()
    view: VisibilityConfig = VisibilityConfig()
    contacts: ContactStopConfig = ContactStopConfig()
