# SPDX-License-Identifier: Apache-2.0
"""What the simulator publishes of what only it knows."""

import numpy as np

from services.sim import dynamics as dyn
from services.sim import people as pedestrians
from services.sim.people import People
from services.sim.world import World
from shared.geometry import Pose2, wrapped
from shared.messages import Truth
from shared.types import Float64s


def true_state(time: int, state: Float64s, world: World, people: People) -> Truth:
    """The truth at `time` (ns). state: as in dynamics.advance.  people: without the discs of other robots."""
    at = people.state[: len(world.people)]
    return Truth(
        stamp=time,
        world_from_base=Pose2(float(state[dyn.X]), float(state[dyn.Y]), wrapped(float(state[dyn.YAW]))),
        start=world.start,
        v=float(state[dyn.V]),
        w=float(state[dyn.W]),
        contact=bool(state[dyn.CONTACT]),
        n_contacts=int(state[dyn.N_CONTACTS]),
        distance=float(state[dyn.DISTANCE]),
        people_x=at[:, pedestrians.X].astype(np.float32),
        people_y=at[:, pedestrians.Y].astype(np.float32),
    )
