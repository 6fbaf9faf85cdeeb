"""Deformation of people: the Gaussians of a walker move in its box, by a small network of time.

After the deformable nodes of OmniRe (Chen et al., 2025, §4.2): each such actor has a learned code, and a
network that all of them share turns code, place and time into a shift and a turn of each Gaussian. The
Gaussians stay the same ones, so that relocation and growth work as for rigid actors. Within an exposure or a
sweep a shape stays as it is in the middle: only the box moves.
"""

import dataclasses
import math

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from foredrive.geometry.quaternions import multiply_quaternions
from foredrive.methods.reconstruction.gaussians import Gaussians
from foredrive.methods.reconstruction.tracks import ActorTracks, nonrigid_rows

CODE = 8
"""Length of an actor's code."""
WIDTH = 32
TIME_HZ = (0.25, 0.5, 1.0)
"""Frequencies in which time is written: a leg swings about once a second. With 2 Hz as well, the shapes
between training frames of 5 Hz get worse."""
PLACE_CYCLES = (0.5,)
"""Cycles per box in which a place is written."""
REACH = 0.5
"""Scale of the shifts, in lengths, widths and heights of the box."""
_CODE_STD = 0.1


class Deformation(nn.Module):
    """Shifts and turns of the Gaussians of actors that change their shape.

    Args:
        tracks: all actors of the scene.
    """

    half_lwh: Tensor
    from_s: Tensor
    """First time at which each actor was observed."""
    during_s: Tensor
    """Time from then to the last one."""

    def __init__(self, tracks: ActorTracks) -> None:
        super().__init__()
        people = tracks.only(nonrigid_rows(tracks))
        early = torch.where(people.present, people.t_s, math.inf).amin(1)
        late = torch.where(people.present, people.t_s, -math.inf).amax(1)
        self.register_buffer("half_lwh", people.size_lwh / 2, persistent=False)
        self.register_buffer("from_s", early, persistent=False)
        self.register_buffer("during_s", late - early, persistent=False)
        self.code = nn.Parameter(_CODE_STD * torch.randn(len(people), CODE))
        inputs = 3 * (1 + 2 * len(PLACE_CYCLES)) + 2 * len(TIME_HZ) + CODE
        last = nn.Linear(WIDTH, 6)
        # Actors are rigid at first
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.layers = nn.Sequential(
            nn.Linear(inputs, WIDTH), nn.ReLU(), nn.Linear(WIDTH, WIDTH), nn.ReLU(), last
        )

    def forward(self, gaussians: Gaussians, shape: Int[Tensor, "N"], t_s: float | Tensor) -> Gaussians:
        """Return Gaussians of actors as they are at a time, in the frames of their boxes.

        Args:
            gaussians: in the frames of their boxes.
            shape: row of each one's actor in `code`.
            t_s: seconds since the start of the drive.
        """
        half_lwh = self.half_lwh.index_select(0, shape)
        place = gaussians.mean_m / half_lwh
        then_s = self._observed_s(torch.as_tensor(t_s).to(place)).index_select(0, shape)
        # From -1 to 1 across the box: half a wave for each π
        waves = [math.pi * cycles * place for cycles in PLACE_CYCLES]
        waves += [(2 * math.pi * place.new_tensor(TIME_HZ)) * then_s[:, None]]
        waves_of = [f(wave) for wave in waves for f in (torch.sin, torch.cos)]
        inputs = torch.cat([place, *waves_of, self.code.index_select(0, shape)], dim=-1)
        shift, turn = self.layers(inputs).split(3, dim=-1)
        # A small turn as a quaternion: half the rotation vector beside 1, of any length
        turned = torch.cat([torch.ones_like(turn[:, :1]), turn / 2], dim=-1)
        return dataclasses.replace(
            gaussians,
            mean_m=gaussians.mean_m + 2 * REACH * half_lwh * shift,
            quaternion=multiply_quaternions(turned, gaussians.quaternion),
        )

    def _observed_s(self, t_s: Float[Tensor, ""]) -> Float[Tensor, "P"]:
        """Return the time at which each actor is looked up: outside of its own times, there and back in them.

        So a copy that walks at another time moves its legs too.
        """
        since_s = t_s - self.from_s
        # A triangle wave: forwards through the observed time, then backwards
        cycle_s = (2 * self.during_s).clamp_min(1e-6)
        return self.from_s + torch.minimum(since_s % cycle_s, cycle_s - since_s % cycle_s)
