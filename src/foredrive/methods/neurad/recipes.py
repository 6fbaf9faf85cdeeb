"""Scenes that are neural fields as a representation that recipes can name."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.engine.learning_rates import Rate
from foredrive.geometry.se3 import transform_points
from foredrive.methods.blocks.losses import ImageFeatures
from foredrive.methods.neurad.config import FieldConfig, GridConfig, GridsConfig
from foredrive.methods.neurad.decoders import PatchDecoderConfig
from foredrive.methods.neurad.scene import FieldScene, FieldSceneConfig, saved_field
from foredrive.methods.neurad.training import FieldRates, FieldSchedule, FieldTraining, FieldWeights
from foredrive.methods.reconstruction.tracks import ActorTracks
from foredrive.methods.reconstruction.training import SensorViews
from foredrive.methods.splatad.content import gaussians_of
from foredrive.methods.splatad.initial import AHEAD_LEFT_UP, InitialGaussians, initial_scene

_SHOWN = InitialGaussians(
    lidar_points=20_000,
    unseen_points=10_000,
    pixel_points=0,
    near_points=0,
    actor_points=0,
    max_actor_points=1000,
    features=0,
)
"""Coloured points for viewers."""
_FLOATS_PER_SAMPLE, _FLOATS_PER_PIXEL = 400, 300
"""Floats that autograd keeps for each sample of the field, and for each pixel of a patch."""
_COPIES = 4
"""Copies of each number of a grid: the value, its gradient, two moments."""


@dataclass(frozen=True)
class FieldRecipe:
    """A neural field (Tonderski et al., "NeuRAD", 2024): a `Representation`."""

    schedule: FieldSchedule
    scene: FieldSceneConfig = field(default_factory=FieldSceneConfig)
    kind: Literal["field"] = "field"

    def begin(self, views: SensorViews, tracks: ActorTracks, cameras: int, reach_m: float) -> FieldScene:
        """Return the scene before training. What is not contracted lies about the middle of the path."""
        generator = torch.Generator().manual_seed(self.schedule.seed)
        graph = initial_scene(list(views.cameras), list(views.sweeps), tracks, _SHOWN, generator)
        places = [view.T_scene_cam[:3, 3] for view in views.cameras]
        places += [view.T_scene_ego[:3, 3] for view in views.sweeps]
        # Mean position of all sensors
        middle_m = torch.stack(places).mean(0) if places else torch.zeros(3)
        scale_m = padded_scale_m(views, middle_m) if self.scene.network.scale_m is None else None
        torch.manual_seed(self.schedule.seed)  # the weights
        return FieldScene(tracks, gaussians_of(graph), cameras, self.scene, reach_m, middle_m, scale_m)

    def open(self, weights: Path, reach_m: float) -> FieldScene:
        """Return a scene of the sizes of saved weights, which are to be loaded into it."""
        return saved_field(weights, self.scene, reach_m)

    def training(
        self, scene: FieldScene, views: SensorViews, tower: Callable[[], ImageFeatures] | None = None
    ) -> FieldTraining:
        """Return the training of a scene on views."""
        return FieldTraining(scene, views, self.schedule, tower)

    def complete(self, scene: FieldScene, T_scene_ego: Float[Tensor, "K 4 4"], views: SensorViews) -> None:
        """Do nothing: a field is defined everywhere."""

    def learning_gib(self, pixels: int) -> float:
        """Estimate the memory that training takes besides its data, GiB."""
        sizes, schedule = self.scene.network, self.schedule
        grids = (sizes.grids, *sizes.proposals)
        entries = sum(
            g.levels * g.features * 2**g.log2_rows for pair in grids for g in (pair.static, pair.actors)
        )
        rays = schedule.patches * schedule.patch**2 + schedule.beams
        # Four proposal samples are counted as one sample of the field
        samples = rays * (sizes.samples + sum(sizes.proposal_samples) / 4)
        patch_floats = 9 * schedule.patches * schedule.patch**2 * _FLOATS_PER_PIXEL
        return 4 * (entries * _COPIES + samples * _FLOATS_PER_SAMPLE + patch_floats) / 1024**3


def padded_scale_m(views: SensorViews, middle_m: Float[Tensor, "3"]) -> float:
    """Return the half side of the cube about `middle_m` that holds the surroundings of all poses, m.

    The surroundings are 80 m ahead and behind and 60 m to the sides, as in NeuRAD's reference implementation,
    and 30 m up. Cameras stand in where there are no sweeps.
    """
    poses = [view.T_scene_ego for view in views.sweeps] or [
        view.T_scene_cam @ AHEAD_LEFT_UP for view in views.cameras
    ]
    # Points around each pose, in its own axes: ahead, behind, left, right
    around = torch.tensor([[80.0, 0, 0], [-80, 0, 0], [0, 60, 0], [0, -60, 0]])
    places = [transform_points(T, around.to(T)) - middle_m.to(T) for T in poses]
    return max([30.0, *(float(place[:, :2].abs().max()) for place in places)])


def tiny_field() -> FieldRecipe:
    """Return a field for half an hour on two cores, with images of 480×270."""
    actors = GridConfig(levels=4, features=2, coarsest=64, finest=1024, log2_rows=17)
    return FieldRecipe(
        schedule=FieldSchedule(
            steps=12_000,
            patches=2,
            patch=32,
            beams=1024,
            sweeps=2,
            poses_every=4,
            proposals_every=2,
            weights=FieldWeights(hit=0.05),
            rates=FieldRates(
                grids=Rate(1e-2, warmup_steps=100),
                layers=Rate(1e-2, warmup_steps=100),
                decoder=Rate(3e-3, warmup_steps=100),
                actor_offset=Rate(1e-4, warmup_steps=1_000),
                camera_offset=Rate(1e-5, warmup_steps=1_000),
                camera_twist=Rate(1e-4, warmup_steps=1_000),
                camera_late_s=Rate(1e-5, warmup_steps=1_000),
            ),
        ),
        scene=FieldSceneConfig(
            network=FieldConfig(
                grids=GridsConfig(
                    GridConfig(levels=8, features=2, coarsest=32, finest=8192, log2_rows=17), actors
                ),
                proposals=(
                    GridsConfig(
                        GridConfig(levels=6, features=1, coarsest=32, finest=2048, log2_rows=17),
                        GridConfig(levels=4, features=1, coarsest=64, finest=1024, log2_rows=15),
                    ),
                ),
                proposal_samples=(32,),
                samples=16,
                surface="density",
                shading="rays",
                appearance=8,
            ),
            decoder=PatchDecoderConfig(
                width=24, fine_width=16, kernel=3, coarse_blocks=1, fine_blocks=1, batch_norm=False
            ),
        ),
    )


def base_field() -> FieldRecipe:
    """Return NeuRAD in the sizes and with the choices of its reference implementation."""
    return FieldRecipe(
        schedule=FieldSchedule(steps=20_001, free_m=150.0),
        scene=FieldSceneConfig(network=FieldConfig(resampling="padded", biases=False), whole_ranges=False),
    )
