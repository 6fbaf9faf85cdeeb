"""A page for a reconstructed log: over time, from any viewpoint, with edits."""

import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import cast

import numpy as np
import torch
import viser
from viser.transforms import SO3

from foredrive.errors import InputError
from foredrive.methods.reconstruction.edits import Edit, EditedScene
from foredrive.methods.reconstruction.novel_views import novel_camera_view
from foredrive.runs.reconstruction.reconstruction_run import OpenedReconstruction
from foredrive.runs.reconstruction.render import RenderedFrame, RenderPlan, render_frame
from foredrive.view.edit_panel import EditPanel
from foredrive.view.image_drawing import to_image
from foredrive.view.model_panel import pinhole
from foredrive.view.page import Page
from foredrive.view.reconstruction_nodes import ReconstructedNodes
from foredrive.view.reconstruction_video import Colour, sweep_colours
from foredrive.view.scene_nodes import CAMERAS, POINT_M, clear, show_camera, show_ego

_log = logging.getLogger(__name__)


class JobRunner:
    """One thread that runs named jobs. A waiting job is replaced by a newer job with the same name.

    The name that has waited longest runs first, so that no name starves when jobs arrive faster than they
    run. A failure is reported, and the next job runs.

    Args:
        tell: called with the message of a job that failed.
    """

    def __init__(self, tell: Callable[[str], None]) -> None:
        self._tell = tell
        self._changed = threading.Condition()
        self._wanted: dict[str, Callable[[], None]] = {}
        self._last_turn: dict[str, int] = {}
        self._turns, self._busy, self._closed = 0, False, False
        self._thread = threading.Thread(target=self._work, name="foredrive-page", daemon=True)
        self._thread.start()

    def submit(self, name: str, job: Callable[[], None]) -> None:
        """Queue a job in place of an older one of this name that has not begun."""
        with self._changed:
            self._wanted[name] = job
            self._changed.notify_all()

    def wait(self) -> None:
        """Wait until no job is left."""
        with self._changed:
            self._changed.wait_for(lambda: not self._wanted and not self._busy)

    def close(self) -> None:
        """Drop queued jobs, and wait for the running one."""
        with self._changed:
            self._wanted.clear()
            self._closed = True
            self._changed.notify_all()
        self._thread.join()

    def _work(self) -> None:
        while (job := self._next()) is not None:
            try:
                job()
            except InputError as error:
                self._tell(str(error))
            except Exception as error:  # An error of the program, after which the page continues
                _log.exception("while drawing")
                self._tell(f"{type(error).__name__}: {error}")

    def _next(self) -> Callable[[], None] | None:
        with self._changed:
            self._busy = False
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._wanted or self._closed)
            if self._closed:
                return None
            self._turns, self._busy = self._turns + 1, True
            # The name whose last turn is the longest ago; one that has not run yet comes first
            name = min(self._wanted, key=lambda name: self._last_turn.get(name, 0))
            self._last_turn[name] = self._turns
            return self._wanted.pop(name)


OWN_HEIGHT_PX = 360
"""Height of the picture from the browser's viewpoint, px."""
LIDAR = "/lidar"


@dataclass(frozen=True)
class SceneAtTime:
    """An edited scene at one time."""

    edited: EditedScene
    t_s: float


class ReconstructionPictures:
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
            # One job for each sensor: a newer time replaces a waiting job of the same sensor
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
        # All nodes of the page are in the ego frame, so the browser's camera is too
        T_ego_cam = np.eye(4)
        T_ego_cam[:3, :3], T_ego_cam[:3, 3] = SO3(camera.wxyz).as_matrix(), camera.position
        rig = pinhole(T_ego_cam, camera.fov, camera.aspect, OWN_HEIGHT_PX)
        ego = self._run.vehicle.at(shown.t_s).shifted(shown.edited.T_ego_shifted.cpu())
        scene = self._run.scene
        with torch.no_grad():
            view = novel_camera_view(rig, 0, ego, sensor=0).to(scene.device)
            rgb = to_image(scene.camera(shown.edited.graph, view).rgb)
        client.scene.set_background_image(rgb, format="jpeg", jpeg_quality=90)


STEP_S = 0.1
"""Step of the slider and of playing in real time, s."""
FAR_M = 5000.0
"""The browser's far plane, m: the sky is about two kilometres away."""
NUDGES_S = (2.0, 6.0)
"""Pauses before each new sorting of the splats for a new browser, s."""
NOTE_S = 8.0


class ReconstructedViewer(Page):
    """A page with a slider for time, sensors rendered at that time, and edits.

    The browser itself draws the Gaussians' albedo. Sensor images are rendered in the background, the newest
    time first, so that the slider never waits. All nodes are in the ego frame at the time shown. The server
    runs in its own threads until `close`.

    Args:
        run: the shown reconstruction.
        edits: initial edits.
        file: default file for saved edits; the page can change it.
        host, port: address of the page; if the port is taken, the next free one.

    Raises:
        InputError: the page cannot be served there.
    """

    def __init__(
        self, run: OpenedReconstruction, edits: Sequence[Edit], file: Path, host: str, port: int
    ) -> None:
        super().__init__(run.folder.name, host, port)
        self.run = run
        self.server.initial_camera.far = FAR_M
        self.jobs = JobRunner(self.tell)
        show_ego(self.server.scene)
        # Without gradients, because the scene is only shown
        graph = run.scene.graph.map_tensors(lambda tensor: tensor.detach())
        path_m = run.vehicle.T_scene_ego[:, :3, 3].to(graph.content.device)
        self.nodes = ReconstructedNodes(
            self.server.scene, graph, path_m, lambda track_id: self.edits.choose(track_id)
        )
        self._add_controls()
        self.edits = EditPanel(self.server, graph, self.nodes, file, self.tell, self.show_now)
        self.pictures = ReconstructionPictures(self.server, run, self.jobs)
        self.server.on_client_connect(self._welcome)
        # `replace` draws the scene if the edits can be made
        if not self.edits.replace(edits):
            self.show_now()

    def show(self, t_s: float) -> None:
        """Go to a time since the start of the log, s."""
        self.time_s.value = t_s  # Calls `show_now`, unless the value is the same

    def show_now(self) -> None:
        """Draw the scene as it is now; the sensors' pictures follow."""
        with self.edits.lock, self.server.atomic():
            t_s, edited = float(self.time_s.value), self.edits.edited
            ego = self.run.vehicle.at(t_s).shifted(edited.T_ego_shifted.cpu())
            self.nodes.show(edited.graph, ego.T_scene_ego, t_s)
            self.edits.show(t_s)
            self.pictures.show(edited, t_s)
            self._show_own_views()

    def play(self) -> None:
        """Step through the log in real time while "play" is ticked on the page; never return."""
        first_s, last_s = float(self.run.vehicle.t_s[0]), float(self.run.vehicle.t_s[-1])
        while True:
            began_s = time.monotonic()
            if self._play.value:
                later_s = self.time_s.value + STEP_S
                self.show(later_s if later_s <= last_s else first_s)
            time.sleep(max(STEP_S - (time.monotonic() - began_s), 0.01))

    def tell(self, message: str) -> None:
        """Show a message to every client."""
        for client in self.server.get_clients().values():
            client.add_notification("", message, auto_close_seconds=NOTE_S)

    def close(self) -> None:
        """Stop rendering and serving."""
        self.jobs.close()
        super().close()

    def _add_controls(self) -> None:
        gui, vehicle, preview = self.server.gui, self.run.vehicle, self.run.scene.preview_name
        first_s, last_s = float(vehicle.t_s[0]), float(vehicle.t_s[-1])
        with gui.add_folder("Time"):
            self.time_s = gui.add_slider("time, s", first_s, max(last_s, first_s + STEP_S), STEP_S, first_s)
            self._play = gui.add_checkbox("play", False)
        with gui.add_folder("Scene"):
            self._note = gui.add_markdown(self._count())
            self.own = gui.add_checkbox(
                "render my view",
                False,
                disabled=not vehicle.rig.names,
                hint=f"by the renderer that cameras use, in the place of {preview} that the browser draws",
            )
            labels = {name: name for name in ("splats", "boxes", "ids", "lidar", "cameras")}
            labels["splats"] = preview
            self.layers = {name: gui.add_checkbox(label, True) for name, label in labels.items()}
        self.time_s.on_update(lambda _: self.show_now())
        self.own.on_update(lambda _: self._toggle_own())
        for box in self.layers.values():
            box.on_update(lambda _: self._show_layers())

    def _count(self) -> str:
        share, preview = self.nodes.share, self.run.scene.preview_name
        drawn = (
            "" if share == 1 else f"; the browser draws {share:.0%} of the {preview}, those that cover most"
        )
        if share == 1 and preview != "splats":
            drawn = f"; the browser draws {preview}, sensors show the scene itself"
        return f"{self.run.scene.described}, {len(self.run.scene.track_id)} actors{drawn}"

    def _show_layers(self) -> None:
        for name in self.nodes.layers:
            self.nodes.layers[name] = self.layers[name].value
        # The rendered view replaces the splats that the browser draws
        self.nodes.layers["splats"] &= not self.own.value
        for name in self.pictures.layers:
            self.pictures.layers[name] = self.layers[name].value
        self.nodes.show_layers()
        self.pictures.show_layers()

    def _toggle_own(self) -> None:
        self._show_layers()
        self._show_own_views()
        if not self.own.value:
            for client in self.server.get_clients().values():
                client.scene.set_background_image(None)

    def _show_own_views(self) -> None:
        if self.own.value:
            for client in self.server.get_clients().values():
                self.pictures.request_own_view(client)

    def _welcome(self, client: viser.ClientHandle) -> None:
        client.camera.on_update(lambda _: self.pictures.request_own_view(client) if self.own.value else None)
        for pause_s in NUDGES_S:
            time.sleep(pause_s)
            self.nodes.nudge()
