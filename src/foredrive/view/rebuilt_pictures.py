"""Sensor pictures of a reconstructed scene, rendered in the background."""

from dataclasses import dataclass
from functools import partial
from typing import cast

import numpy as np
import torch
import viser
from viser.transforms import SO3

from foredrive.rendering.edits import EditedScene
from foredrive.rendering.novel_views import novel_camera_view
from foredrive.runs.rebuild.rebuilt_run import OpenedReconstruction
from foredrive.runs.rebuild.render import RenderedFrame, RenderPlan, render_frame
from foredrive.view.image_drawing import to_image
from foredrive.view.job_runner import JobRunner
from foredrive.view.model_panel import pinhole
from foredrive.view.rebuilt_video import Colour, sweep_colours
from foredrive.view.scene_nodes import CAMERAS, POINT_M, clear, show_camera

OWN_HEIGHT_PX = 360
"""Height of the picture from the browser's viewpoint, px."""
LIDAR = "/lidar"


@dataclass(frozen=True)
class SceneAtTime:
    """An edited scene at one time."""

    edited: EditedScene
    t_s: float


class RebuiltPictures:
    """Pictures of the rig's cameras, the lidar's points, and the view from the browser's viewpoint.

    Args:
        server: server of the page.
        run: the shown reconstruction.
        jobs: thread that renders everything.
    """

    def __init__(self, server: viser.ViserServer, run: OpenedReconstruction, jobs: JobRunner) -> None:
        self._server, self._run, self._jobs = server, run, jobs
        self._shown: SceneAtTime | None = None
        self.layers = {"lidar": True, "cameras": True}
        server.scene.add_frame(CAMERAS, show_axes=False)
        gui, rig = server.gui, run.vehicle.rig
        blank = np.zeros((*rig.size_hw, 3), np.uint8)
        with gui.add_folder("Sensors"):
            self.colour = gui.add_dropdown(
                "lidar by", ("height", "intensity"), visible=run.vehicle.lidar is not None
            )
            self.images = [gui.add_image(blank, label=name, jpeg_quality=85) for name in rig.names]
        self.colour.on_update(lambda _: self._request_lidar())

    def show(self, edited: EditedScene, t_s: float) -> None:
        """Request pictures at a time; queued requests of earlier times are dropped."""
        self._shown = SceneAtTime(edited, t_s)
        self._request_lidar()
        for camera, name in enumerate(self._run.vehicle.rig.names):
            self._jobs.submit(name, partial(self._show_camera, camera, self._shown))

    def show_layers(self) -> None:
        """Show the layers that are switched on."""
        for name in (LIDAR, CAMERAS):
            if (node := self._server.scene.get_handle_by_name(name)) is not None:
                node.visible = self.layers[name[1:]]

    def request_own_view(self, client: viser.ClientHandle) -> None:
        """Render from the viewpoint of one browser, as the background of its page."""
        self._jobs.submit(f"client {client.client_id}", partial(self._show_own_view, client))

    def _request_lidar(self) -> None:
        if self._shown is not None and self._run.vehicle.lidar is not None:
            self._jobs.submit(LIDAR, partial(self._show_lidar, self._shown))

    def _shot(self, shown: SceneAtTime, plan: RenderPlan) -> RenderedFrame:
        return render_frame(self._run.scene, self._run.vehicle, shown.edited, plan, 0)

    def _show_camera(self, camera: int, shown: SceneAtTime) -> None:
        rig = self._run.vehicle.rig
        shot = self._shot(shown, RenderPlan((shown.t_s,), 1.0, (camera,), None))
        rgb = shot.images[0].permute(1, 2, 0).numpy()
        self.images[camera].image = rgb
        show_camera(self._server.scene, rig, camera, rgb)

    def _show_lidar(self, shown: SceneAtTime) -> None:
        sweep = self._shot(shown, RenderPlan((shown.t_s,), 1.0, (), self._run.vehicle.lidar)).sweep
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
        assert self._shown is not None
        camera, shown = client.camera, self._shown
        T_ego_cam = np.eye(4)
        T_ego_cam[:3, :3], T_ego_cam[:3, 3] = SO3(camera.wxyz).as_matrix(), camera.position
        rig = pinhole(T_ego_cam, camera.fov, camera.aspect, OWN_HEIGHT_PX)
        ego = self._run.vehicle.at(shown.t_s).shifted(shown.edited.T_ego_shifted.cpu())
        scene = self._run.scene
        with torch.no_grad():
            view = novel_camera_view(rig, 0, ego, sensor=0).to(scene.device)
            rgb = to_image(scene.camera(shown.edited.graph, view).rgb)
        client.scene.set_background_image(rgb, format="jpeg", jpeg_quality=90)
