"""The part of the page that shows a model's predictions, and renders them from the browser's viewpoint."""

import math
import threading
from typing import cast

import numpy as np
import torch
import viser
from jaxtyping import Float
from viser.transforms import SO3

from foredrive.metrics.occupancy import ABOVE_GROUND_M
from foredrive.runs.evaluate.display import DisplayPrediction
from foredrive.scene import CameraRig
from foredrive.view import palette
from foredrive.view.image_drawing import to_image
from foredrive.view.log_frames import LogFrames
from foredrive.view.scene_nodes import FRUSTUM_M, show_path
from foredrive.view.task_nodes import show_agents, show_lines
from foredrive.view.volume_nodes import (
    ColourBy,
    show_flow,
    show_occupancy,
    show_true_classes,
    shown_voxels,
)

RENDERED_HEIGHT_PX = 160
NODES = ("occupancy", "flow", "plan")
TASK_NODES = ("found boxes", "found map", "true voxels")
"""Shown where the run has task heads."""


class ModelPanel:
    """Controls and nodes of one run's model.

    Args:
        server: server of the page.
        frames: a log with a run.
    """

    def __init__(self, server: viser.ViserServer, frames: LogFrames) -> None:
        assert frames.run is not None
        assert frames.predictor is not None
        self._server, self._frames, self._predictor = server, frames, frames.predictor
        self.spec, self._dt_s = frames.run.recipe.clips.voxels, frames.run.recipe.clips.frame_dt_s
        self._index, self._drawing = 0, threading.Lock()
        gui, steps, spec = server.gui, self._predictor.steps, self.spec
        low_m, high_m = spec.lower_m[2], spec.upper_m[2] - spec.voxel_m
        above_road = low_m + spec.voxel_m * math.ceil((ABOVE_GROUND_M - low_m) / spec.voxel_m)
        with gui.add_folder("Model"):
            self._note = gui.add_markdown("")
            self.frame = gui.add_slider("imagined frame", 0, max(steps, 1), 1, 0, disabled=steps == 0)
            nodes = NODES if self._predictor.heads is None else (*NODES, *TASK_NODES)
            self.boxes = {name: gui.add_checkbox(name, True) for name in nodes}
            ways = ("height", "features") if frames.taxonomy is None else ("classes", "height", "features")
            self.colour_by = gui.add_dropdown("coloured by", ways)
            self.above = gui.add_slider("probability >", 0.05, 0.95, 0.05, 0.5)
            self.min_height_m = gui.add_slider(
                "height, m >", low_m, high_m, spec.voxel_m, min(above_road, high_m)
            )
            render = gui.add_button(
                "Render from here",
                hint="render the predicted volume from this viewpoint",
                visible=self._predictor.renders,
            )
            self._rendered = gui.add_image(np.zeros((1, 1, 3), np.uint8), visible=False)
        for slider in (self.frame, self.above, self.min_height_m):
            slider.on_update(lambda _: self.show(self._index))
        for box in self.boxes.values():
            box.on_update(lambda _: self.show(self._index))
        self.colour_by.on_update(lambda _: self.show(self._index))
        render.on_click(self._render_from)

    def show(self, index: int) -> None:
        """Draw the model's predictions at a frame of the log."""
        with self._drawing:
            self._index = index
            prediction, k, scene = self._frames.prediction(index), self.frame.value, self._server.scene
            self._note.content = self._when(k) if prediction is not None else "too few frames before this one"
            with self._server.atomic():
                if prediction is not None:
                    spec = self.spec
                    shown = shown_voxels(prediction, k, spec, self.above.value, self.min_height_m.value)
                    colour_by = cast(ColourBy, self.colour_by.value)
                    show_occupancy(scene, prediction, k, spec, shown, colour_by)
                    show_flow(scene, prediction, k, spec, shown)
                    show_path(scene, "plan", prediction.plan, palette.PLAN)
                    self._show_tasks(prediction)
                for name, box in self.boxes.items():
                    node = scene.get_handle_by_name(f"/{name}")
                    if node is not None:
                        node.visible = box.value and prediction is not None

    def _show_tasks(self, prediction: DisplayPrediction) -> None:
        """Draw what the task heads have found now, and the true voxels beside it."""
        scene = self._server.scene
        show_agents(scene, prediction.agents)
        show_lines(scene, prediction.lines)
        if self._frames.taxonomy is not None:
            true = self._frames.true_classes(self._index)
            show_true_classes(scene, true, self._frames.taxonomy, self.spec, self.min_height_m.value)

    def _when(self, k: int) -> str:
        return f"imagined, **{k * self._dt_s:g} s** ahead" if k else "observed **now**"

    def _render_from(self, event: viser.GuiEvent) -> None:
        """Render from the viewpoint of the browser that pressed the button, and keep the picture there."""
        if event.client is None:
            return
        with self._drawing:
            prediction, k = self._frames.prediction(self._index), self.frame.value
            if prediction is None:
                return
            camera = event.client.camera
            T_now_cam = np.eye(4)
            T_now_cam[:3, :3], T_now_cam[:3, 3] = SO3(camera.wxyz).as_matrix(), camera.position
            T_ego_cam = np.linalg.inv(prediction.T_now_ego[k].double().numpy()) @ T_now_cam
            rig = pinhole(T_ego_cam, camera.fov, camera.aspect, RENDERED_HEIGHT_PX)
            rgb = to_image(self._predictor.render(prediction, k, rig)[0].permute(2, 0, 1))
        self._rendered.image, self._rendered.visible = rgb, True
        self._server.scene.add_camera_frustum(
            "/rendered",
            fov=camera.fov,
            aspect=camera.aspect,
            scale=FRUSTUM_M,
            color=palette.rgb255(palette.PLAN),
            image=rgb,
            wxyz=camera.wxyz,
            position=camera.position,
        )


def pinhole(
    T_ego_cam: Float[np.ndarray, "4 4"], fov_y_rad: float, aspect: float, height_px: int
) -> CameraRig:
    """Return an ideal pinhole camera with this vertical field of view, without leading dimensions."""
    width_px = max(round(aspect * height_px), 1)
    focal = height_px / 2 / float(np.tan(fov_y_rad / 2))
    return CameraRig(
        K=torch.tensor([[[focal, 0.0, width_px / 2], [0.0, focal, height_px / 2], [0.0, 0.0, 1.0]]]),
        T_ego_cam=torch.from_numpy(T_ego_cam).float()[None],
        dist=torch.zeros(1, 5),
        readout_s=torch.zeros(1),
        names=("here",),
        size_hw=(height_px, width_px),
    )
