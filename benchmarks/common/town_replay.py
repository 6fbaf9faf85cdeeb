"""A recorded drive of a town, seen by the town's own sensors: the truth beside its reconstruction.

The road users replay the recorded drive, as those of a reconstructed log do. So a test in the
reconstruction and one with this renderer differ in what the sensors show, and in nothing else.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from foredrive.errors import InputError
from foredrive.methods.reconstruction.tracks import ActorTracks, states_at
from foredrive.scene import CameraRig, Category, Rendered
from foredrive.scene.actors import ActorState
from foredrive.towns.sensing.capture import SensorSuite
from foredrive.towns.traffic.expert import DriveSnapshot
from foredrive.towns.world import World

ON_TIME_S = 1e-3


class TownReplayRenderer:
    """A `Renderer` of a recorded drive, with actors that were added to it.

    Args:
        world: the town of the drive.
        sensors: the vehicle's sensors.
        moments: the recorded drive.
        tracks: tracks of the scene, in the frame of its first ego pose.
        T_world_scene: that frame in the world.
        copied: for each actor that was added, by its track id: the track id of the actor that it looks like.

    Raises:
        InputError: the town has no actor that an added one could look like.
    """

    def __init__(
        self,
        world: World,
        sensors: SensorSuite,
        moments: Sequence[DriveSnapshot],
        tracks: ActorTracks,
        T_world_scene: Float64[Tensor, "4 4"],
        copied: Mapping[int, int],
    ) -> None:
        self._world, self._sensors, self._moments = world, sensors, moments
        self._T_world_scene = T_world_scene
        # Added actors are tracks of the scene that look like actors of the town
        rows = torch.tensor([tracks.index_of(number) for number in copied], dtype=torch.int64)
        self._added = tracks.map_tensors(lambda tensor: tensor.detach().cpu()).only(rows)
        actors = {actor.track_id: actor for moment in moments for actor in moment.actors}
        actors |= {actor.track_id: actor for actor in world.parked}
        if missing := [number for number in copied.values() if number not in actors]:
            raise InputError(f"the town has no actors {missing} that others could look like")
        self._models = [actors[number] for number in copied.values()]

    @property
    def rig(self) -> CameraRig:
        """Return the cameras of the vehicle."""
        return self._sensors.rig

    def render(
        self, T_world_ego: Float64[Tensor, "4 4"], twist_ego: Float[Tensor, "6"], t_s: float
    ) -> Rendered:
        """Render the sensors. Range and image noise depend on the time alone.

        Raises:
            InputError: the drive has no moment at this time.
        """
        times = np.array([moment.t_s for moment in self._moments])
        index = int(np.argmin(np.abs(times - t_s)))
        if abs(times[index] - t_s) > ON_TIME_S:
            raise InputError(f"the drive has no moment at {t_s:g} s; the next is at {times[index]:g} s")
        moment = self._moments[index]
        seen = self._world.render(
            [*moment.actors, *self._actors(t_s)],
            self._sensors,
            T_world_ego.numpy(),
            twist_ego.double().numpy(),
            index,
            moment.lights,
        )
        images = np.stack(list(seen.images.values()))
        return Rendered(torch.from_numpy(images).permute(0, 3, 1, 2).contiguous(), seen.sweep)

    def _actors(self, t_s: float) -> list[ActorState]:
        """Return the added actors that are there at a time."""
        states, actors = states_at(self._added, t_s), []
        # From the scene's frame to the world, for positions and velocities
        T_world_actor = (self._T_world_scene @ states.T_scene_actor.double()).numpy()
        velocity = states.velocity_mps.double() @ self._T_world_scene[:3, :3].T
        for row, model in enumerate(self._models):
            if bool(states.present[row]):
                forward = T_world_actor[row, :3, 0]
                actors.append(
                    ActorState(
                        track_id=int(self._added.track_id[row]),
                        category=Category(int(self._added.category[row])),
                        centre_m=T_world_actor[row, :3, 3],
                        yaw=float(np.arctan2(forward[1], forward[0])),
                        pitch=float(-np.arcsin(np.clip(forward[2], -1.0, 1.0))),
                        size_lwh=model.size_lwh,
                        velocity_mps=velocity[row].numpy(),
                        style=model.style,
                        parked=False,
                    )
                )
        return actors
