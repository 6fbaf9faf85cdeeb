"""Sensor rendering of a rebuilt scene: the `Renderer` for drives in rebuilt logs."""

import dataclasses
from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from foredrive.geometry.se3 import inverse_se3
from foredrive.rendering.novel_views import novel_camera_view, novel_sweep_view, rendered_sweep
from foredrive.rendering.rebuilt import RebuiltScene
from foredrive.rendering.scene_graph import SceneGraph
from foredrive.rendering.vehicle import EgoState, LoggedVehicle
from foredrive.scene import CameraRig, Rendered


@dataclass(frozen=True, eq=False)
class RebuiltRenderer:
    """A `Renderer` of a rebuilt scene with the sensors of its log."""

    scene: RebuiltScene
    graph: SceneGraph
    """The scene's own graph, or an edited version of it."""
    vehicle: LoggedVehicle

    @property
    def rig(self) -> CameraRig:
        """The log's cameras at their mounts."""
        return dataclasses.replace(self.vehicle.rig, exposed_dt_s=None)

    @torch.no_grad()
    def render(
        self, T_world_ego: Float64[Tensor, "4 4"], twist_ego: Float[Tensor, "6"], t_s: float
    ) -> Rendered:
        """Render the cameras exposed at a time of the log and the lidar revolution that ends then."""
        T_scene_ego = (inverse_se3(self.vehicle.T_world_scene) @ T_world_ego).float()
        ego = EgoState(T_scene_ego, twist_ego, t_s)
        device, rig = self.scene.actor.device, self.rig
        images = torch.zeros(len(rig.names), 3, *rig.size_hw, dtype=torch.uint8)
        for camera in range(len(rig.names)):
            rgb = self.scene(self.graph, novel_camera_view(rig, camera, ego).to(device)).rgb
            images[camera] = (255 * rgb.clamp(0, 1)).round().to(torch.uint8).cpu()
        if self.vehicle.lidar is None:
            return Rendered(images, None)
        view = novel_sweep_view(self.vehicle.lidar, ego)
        picture = self.scene.sweep(self.graph, self.scene.prepare_sweep(view), t_s)
        return Rendered(images, rendered_sweep(view, picture))
