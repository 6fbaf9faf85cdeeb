"""Sensor rendering of a reconstructed scene: the `Renderer` for drives in reconstructed logs."""

import dataclasses
from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from foredrive.geometry.se3 import inverse_se3
from foredrive.methods.reconstruction.novel_views import novel_camera_view, novel_sweep_view, rendered_sweep
from foredrive.methods.reconstruction.reconstructed import ReconstructedScene
from foredrive.methods.reconstruction.scene_graph import SceneGraph
from foredrive.methods.reconstruction.trust import Trust
from foredrive.methods.reconstruction.vehicle import EgoState, LoggedVehicle
from foredrive.scene import CameraRig, LidarSweep, Rendered
from foredrive.sensors import SpinningLidar


@dataclass(frozen=True, eq=False)
class ReconstructedRenderer:
    """A `Renderer` of a reconstructed scene with the sensors of a vehicle, usually that of its log."""

    scene: ReconstructedScene
    graph: SceneGraph
    """The scene's own graph, or an edited version of it."""
    vehicle: LoggedVehicle
    trust: Trust | None = None
    """Judges the rendered frames; None: nothing is said about them."""

    @property
    def rig(self) -> CameraRig:
        """The vehicle's cameras at their mounts."""
        # Without exposure offsets, every camera is exposed at the given time
        return dataclasses.replace(self.vehicle.rig, exposed_dt_s=None)

    @torch.no_grad()
    def render(
        self, T_world_ego: Float64[Tensor, "4 4"], twist_ego: Float[Tensor, "6"], t_s: float
    ) -> Rendered:
        """Render the cameras exposed at a time of the log and the lidar revolution that ends then."""
        # The scene's frame is near the drive, so 32 bits are enough for its coordinates
        T_scene_ego = (inverse_se3(self.vehicle.T_world_scene) @ T_world_ego).float()
        ego = EgoState(T_scene_ego, twist_ego, t_s)
        rig, lidar = self.rig, self.vehicle.lidar
        learned = self.vehicle.learned or range(len(rig.names))
        views = [novel_camera_view(rig, camera, ego, sensor) for camera, sensor in enumerate(learned)]
        shown = [(view, self.scene.camera(self.graph, view.to(self.scene.device))) for view in views]
        images = torch.zeros(len(rig.names), 3, *rig.size_hw, dtype=torch.uint8)
        for camera, (_, image) in enumerate(shown):
            images[camera] = image.rgb_8bit
        sweep = None if lidar is None else render_sweep(self.scene, self.graph, lidar, ego)
        trusted = None
        if self.trust is not None:
            trusted = self.trust.trusts(self.trust.psnr_db(self.graph, shown))
        return Rendered(images, sweep, trusted)


@torch.no_grad()
def render_sweep(
    scene: ReconstructedScene, graph: SceneGraph, lidar: SpinningLidar, ego: EgoState
) -> LidarSweep:
    """Render the revolution of a lidar that ends at a pose and time of the vehicle."""
    view = novel_sweep_view(lidar, ego)
    return rendered_sweep(view, scene.sweep(graph, scene.prepare_sweep(view), ego.t_s))
