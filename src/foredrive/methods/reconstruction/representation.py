"""The protocol of the representations that a recipe for reconstructing logs can name."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from foredrive.methods.blocks.losses import ImageFeatures
from foredrive.methods.reconstruction.reconstructed import ReconstructedScene
from foredrive.methods.reconstruction.tracks import ActorTracks
from foredrive.methods.reconstruction.training import SceneTraining, SensorViews


@runtime_checkable
class Representation(Protocol):
    """The settings of a scene of one kind, and what they make: the scene, its training, an opened scene.

    An implementation is a frozen dataclass of plain values. Its `kind` names it in files.
    """

    @property
    def kind(self) -> str:
        """Return the name of the representation."""
        ...

    @property
    def schedule(self) -> Any:
        """Return the schedule of the training: at least `steps`, `checkpoint_every` and `seed`."""
        ...

    def begin(
        self, views: SensorViews, tracks: ActorTracks, cameras: int, reach_m: float
    ) -> ReconstructedScene:
        """Return the scene before training.

        Args:
            views: training views.
            tracks: actors.
            cameras: number of cameras in the rig.
            reach_m: reach of the log's lidar.
        """
        ...

    def open(self, weights: Path, reach_m: float) -> ReconstructedScene:
        """Return a scene of the sizes of saved weights, which are to be loaded into it.

        Raises:
            InputError: the file cannot be read or holds no weights of such a scene.
        """
        ...

    def training(
        self, scene: Any, views: SensorViews, tower: Callable[[], ImageFeatures] | None = None
    ) -> SceneTraining:
        """Return the training of a scene from `begin` on views.

        Args:
            scene: the scene.
            views: training views.
            tower: loads the features of the image tower that comes with the package, for perceptual losses.

        Raises:
            InputError: there are neither images nor sweeps.
        """
        ...

    def complete(self, scene: Any, T_scene_ego: Float[Tensor, "K 4 4"], views: SensorViews) -> None:
        """Do what follows the training of a scene.

        Args:
            scene: the trained scene.
            T_scene_ego: poses of the ego vehicle, whose frame is on the ground.
            views: training views.
        """
        ...

    def learning_gib(self, pixels: int) -> float:
        """Estimate the memory that training takes besides its data, GiB, with images of so many pixels."""
        ...
