"""A made-up truth of what is on a path."""

import torch

from foredrive.driver.road_user_targets import USERS
from foredrive.driver.route_cells import BESIDE_M, LINE_CELLS
from foredrive.driver.sight import Sight
from foredrive.scene import VoxelSpec
from foredrive.scene.affordances import CELLS, TIMES, Affordances
from foredrive.scene.traffic_light import LightState

SPEC = VoxelSpec((-4.0, -4.0, -1.0), 4.0, (1, 2, 2))


def sight_of(batch: int, light: torch.Tensor | None = None, size: tuple[int, int] = (8, 16)) -> Sight:
    """A sight of two cameras that sees nothing: all numbers 0."""
    return Sight(
        torch.zeros(batch, 4) if light is None else light,
        torch.zeros(batch, 2, 3, *size),
        torch.zeros(batch, 2, *size),
        torch.nn.functional.one_hot(torch.full((batch,), LINE_CELLS)) * 20.0,  # no line is seen
        torch.nn.functional.one_hot(torch.full((batch,), LINE_CELLS)) * 20.0,
        torch.zeros(batch, TIMES, CELLS),
        torch.zeros(batch, 2, len(USERS), *size),
        torch.zeros(batch, len(USERS) + 2, CELLS, len(BESIDE_M)),
    )


def truth(batch: int = 2) -> Affordances:
    """A red light whose lamp is 12 m ahead, and a road user on the path from one second on."""
    occupied = torch.zeros(batch, TIMES, CELLS, dtype=torch.bool)
    occupied[:, 2:, 4] = True
    none, zero = torch.zeros(batch, dtype=torch.bool), torch.zeros(batch)
    return Affordances(
        path_xy=torch.zeros(batch, 72, 2),
        path_valid=torch.zeros(batch, 72, dtype=torch.bool),
        light=torch.full((batch,), int(LightState.RED)),
        light_m=torch.full((batch,), 5.0),
        light_known=~none,
        lamp_xyz=torch.tensor([[[12.0, 0.4, 1.9], [12.0, 40.0, 3.0]]]).expand(batch, 2, 3),
        lamp=torch.tensor([[True, True]]).expand(batch, 2),
        lamps_known=~none,
        sign=~none,
        sign_m=torch.full((batch,), 9.5),
        sign_known=~none,
        lead=none,
        lead_m=zero,
        lead_mps=zero,
        lead_known=~none,
        occupied=occupied,
        occupied_known=torch.ones(batch, TIMES, CELLS, dtype=torch.bool),
    )
