"""Sensor pictures of a reconstructed scene, rendered in the background."""

from dataclasses import dataclass
from functools import partial
from typing import cast

import numpy as np
import torch
import viser
from jaxtyping import UInt8
from torch import Tensor
from viser.transforms import SO3

from foredrive.rendering.edits import EditedScene
from foredrive.rendering.novel_views import novel_camera_view
from foredrive.runs.rebuild.rebuilt_run import OpenedReconstruction
from foredrive.runs.rebuild.render import RenderedFrame, RenderPlan, render_frame
from foredrive.view import palette
from foredrive.view.background import Background
from foredrive.view.model_panel import pinhole
from foredrive.view.rebuilt_video import Colour, sweep_colours
from foredrive.view.scene_nodes import FRUSTUM_M, POINT_M, clear

OWN_HEIGHT_PX = 360
"""Height of the picture from the browser's viewpoint, px."""
LIDAR, CAMERAS = "/lidar", "/cameras"


@dataclass(frozen=True)
class Moment:
    """An edited scene at one time."""

    edited: EditedScene
    t_s: float


class RebuiltPictures:
    """Pictures of the rig's cameras, the lidar's points, and the view from the browser's viewpoint.

    Args:
        server: server of the page.
        run: the shown reconstruction.
        background: thread that renders everything.
    """

    def __init__(self, server: viser.ViserServer, run: OpenedReconstruction, background: Background) -> None:
        self._server, self._run, self._background = server, run, background
        self._moment: Moment | None = None
        self.layers = {"lidar": True, "cameras": True}
        server.scene.add_frame(CAMERAS, show_axes=False)
        gui, rig = server.gui, run.vehicle.rig
        blank = np.zeros((*rig.size_hw, 3), np.uint8)
        with gui.add_folder("Sensors"):
            self.colour = gui.add_dropdown(
                "lidar by", ("height", "intensity"), visible=run.vehicle.lidar is not None
            )
            self.images = [gui.add_image(blank, label=name, jpeg_quality=85) for name in rig.names]
        self.colour.on_update(lambda _: self._ask_lidar())

    def show(self, edited: EditedScene, t_s: float) -> None:
        """Request pictures of a moment; queued requests of earlier moments are dropped."""
        self._moment = Moment(edited, t_s)
        self._ask_lidar()
        for camera, name in enumerate(self._run.vehicle.rig.names):
            self._background.ask(name, partial(self._show_camera, camera, self._moment))

    def show_layers(self) -> None:
        """Show the layers that are switched on."""
        for name in (LIDAR, CAMERAS):
            if (node := self._server.scene.get_handle_by_name(name)) is not None:
                node.visible = self.layers[name[1:]]

    def ask_own_view(self, client: viser.ClientHandle) -> None:
        """Render from the viewpoint of one browser, as the background of its page."""
        self._background.ask(f"client {client.client_id}", partial(self._show_own_view, client))

    def _ask_lidar(self) -> None:
        if self._moment is not None and self._run.vehicle.lidar is not None:
            self._background.ask(LIDAR, partial(self._show_lidar, self._moment))

    def _shot(self, moment: Moment, plan: RenderPlan) -> RenderedFrame:
        return render_frame(self._run.scene, self._run.vehicle, moment.edited, plan, 0)

    def _show_camera(self, camera: int, moment: Moment) -> None:
        rig = self._run.vehicle.rig
        shot = self._shot(moment, RenderPlan((moment.t_s,), 1.0, (camera,), None))
        rgb = shot.images[0].permute(1, 2, 0).numpy()
        self.images[camera].image = rgb
        pose = rig.T_ego_cam[camera].double().numpy()
        self._server.scene.add_camera_frustum(
            f"{CAMERAS}/{rig.names[camera]}",
            fov=2 * float(np.arctan(rig.size_hw[0] / 2 / float(rig.K[camera, 1, 1]))),
            aspect=rig.size_hw[1] / rig.size_hw[0],
            scale=FRUSTUM_M,
            color=palette.rgb255(palette.FAINT),
            image=rgb,
            jpeg_quality=85,
            wxyz=SO3.from_matrix(pose[:3, :3]).wxyz,
            position=pose[:3, 3],
            cast_shadow=False,
            receive_shadow=False,
        )

    def _show_lidar(self, moment: Moment) -> None:
        sweep = self._shot(moment, RenderPlan((moment.t_s,), 1.0, (), self._run.vehicle.lidar)).sweep
        assert sweep is not None
        returned = sweep[sweep.returned]
        if len(returned.range_m) == 0:
            clear(self._server.scene, LIDAR)
            return
        self._server.scene.add_point_cloud(
            LIDAR,
            returned.points_ego.numpy(),
            sweep_colours(returned, cast(Colour, self.colour.value)),
            point_size=POINT_M,
            point_shape="circle",
            visible=self.layers["lidar"],
        )

    def _show_own_view(self, client: viser.ClientHandle) -> None:
        assert self._moment is not None
        camera, moment = client.camera, self._moment
        T_ego_cam = np.eye(4)
        T_ego_cam[:3, :3], T_ego_cam[:3, 3] = SO3(camera.wxyz).as_matrix(), camera.position
        rig = pinhole(T_ego_cam, camera.fov, camera.aspect, OWN_HEIGHT_PX)
        ego = self._run.vehicle.at(moment.t_s).shifted(moment.edited.T_ego_shifted.cpu())
        scene = self._run.scene
        with torch.no_grad():
            view = novel_camera_view(rig, 0, ego, sensor=0).to(scene.actor.device)
            rgb = _bytes(scene(moment.edited.graph, view).rgb)
        client.scene.set_background_image(rgb, format="jpeg", jpeg_quality=90)


def _bytes(rgb: Tensor) -> UInt8[np.ndarray, "H W 3"]:
    return (255 * rgb.clamp(0, 1)).round().to(torch.uint8).permute(1, 2, 0).cpu().numpy()
