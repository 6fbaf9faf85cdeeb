"""A reconstructed scene as nodes in the browser: the static background, and actors in moving frames."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
import viser
from jaxtyping import Float
from torch import Tensor
from viser.transforms import SO3

from foredrive.geometry.boxes import EDGES, box_corners
from foredrive.geometry.se3 import inverse_se3
from foredrive.methods.reconstruction.scene_graph import STATIC, SceneGraph
from foredrive.methods.reconstruction.tracks import states_at
from foredrive.methods.splatad import Gaussians
from foredrive.view import palette

MAX_STD_M = 200.0
"""Maximum standard deviation, m: the browser keeps variances in half precision, which ends at 65504."""
MIN_OPACITY = 1 / 255
"""Minimum opacity of a visible Gaussian at its centre."""
MIN_DISTANCE_M = 5.0
"""Minimum distance in the estimate of coverage, m; nearer Gaussians count as if at this distance."""


def thin_out(gaussians: Gaussians, share: float, from_m: Float[Tensor, "K 3"]) -> Gaussians:
    """Choose the visible Gaussians that cover most, by opacity, largest section and distance.

    Args:
        gaussians: in any frame.
        share: maximum share of the Gaussians that is kept.
        from_m: viewpoints, in the frame of the Gaussians; of two equal Gaussians the farther covers less.
    """
    opacity = gaussians.opacity_logit.sigmoid()
    seen = (opacity >= MIN_OPACITY).nonzero()[:, 0]
    max_count = round(share * len(opacity))
    if len(seen) > max_count:
        # The two longest axes span the largest section; its solid angle falls with the squared distance
        scale_m = gaussians.log_scale.exp().sort(dim=-1).values
        range_m = torch.cdist(gaussians.mean_m, from_m).amin(-1).clamp_min(MIN_DISTANCE_M)
        covers = opacity * scale_m[:, 1] * scale_m[:, 2] / range_m**2
        seen = seen[covers[seen].topk(max_count).indices].sort().values
    return gaussians[seen]


@torch.no_grad()
def show_splats(scene: viser.SceneApi, name: str, gaussians: Gaussians) -> viser.GaussianSplatHandle:
    """Draw Gaussians in the frame of the parent node."""
    factor = gaussians.factor().permute(2, 0, 1)
    # Gaussians that are too large for half precision are scaled down as a whole
    held = (MAX_STD_M / gaussians.log_scale.exp().amax(-1)).clamp_max(1.0)
    factor = factor * held[:, None, None]
    return scene.add_gaussian_splats(
        name,
        centers=_array(gaussians.mean_m),
        covariances=_array(factor @ factor.transpose(-1, -2)),
        rgbs=_array(gaussians.feature[:, :3].clamp(0, 1)),
        opacities=_array(gaussians.opacity_logit.sigmoid()[:, None]),
    )


def _array(values: Tensor) -> np.ndarray:
    return values.detach().cpu().numpy()


ROOT = "/scene"
"""Name of the scene's frame; nodes beside it are in the ego frame at the time shown."""
MAX_SPLATS = 400_000
"""Maximum number of drawn splats; larger scenes are thinned out. At 32 bytes each, these are 13 MB."""
HIDDEN_AT_M = (0.0, 0.0, -1e6)
"""Position of hidden splats, m: the browser draws the splats of invisible nodes too."""
SHOWN_AT_M = (0.0, 0.0, 0.0)
FACE_OPACITY, CHOSEN_OPACITY = 0.06, 0.35
PATH_POINTS = 16
"""Number of points along the vehicle's path from which the distance to a Gaussian is measured."""
EDGE_WIDTH, LABEL_SCALE, NUDGE_M = 2.0, 0.8, 1e-3


@dataclass(frozen=True)
class _ActorNode:
    frame: viser.FrameHandle
    splats: viser.GaussianSplatHandle | None
    face: viser.BoxHandle
    edges: viser.LineSegmentsHandle
    label: viser.LabelHandle
    own: Gaussians
    """The Gaussians before thinning."""


class ReconstructedNodes:
    """The nodes of a scene.

    Args:
        scene: scene of the page.
        graph: initial scene graph.
        path_m: positions of the ego vehicle, in the scene's frame.
        on_click: called with the id of a clicked actor.
    """

    def __init__(
        self,
        scene: viser.SceneApi,
        graph: SceneGraph,
        path_m: Float[Tensor, "K 3"],
        on_click: Callable[[int], None],
    ) -> None:
        self._scene, self._on_click = scene, on_click
        static = graph.content.preview(STATIC)
        actors = [graph.content.preview(row) for row in range(len(graph.tracks))]
        self.share = min(1.0, MAX_SPLATS / max(sum(len(own.mean_m) for own in (static, *actors)), 1))
        """Share of all splats that is drawn."""
        self.layers = {"splats": True, "boxes": True, "ids": True}
        self._root = scene.add_frame(ROOT, show_axes=False)
        static = thin_out(static, self.share, path_m[:: -(-len(path_m) // PATH_POINTS)])
        self._static = show_splats(scene, f"{ROOT}/static", static) if len(static.mean_m) else None
        self._actors: dict[int, _ActorNode] = {}
        self._chosen: int | None = None

    def show(self, graph: SceneGraph, T_scene_ego: Float[Tensor, "4 4"], t_s: float) -> None:
        """Draw the scene at a time in the ego frame; nodes that exist only move."""
        # Actors are placed in the scene's frame below the root, so the static part needs no change
        _place(self._root, inverse_se3(T_scene_ego))
        ids = graph.tracks.track_id.tolist()
        for gone in self._actors.keys() - set(ids):
            self._actors.pop(gone).frame.remove()
        states = states_at(graph.tracks, t_s)
        for row, track_id in enumerate(ids):
            present, own = bool(states.present[row]), graph.content.preview(row)
            node = self._actors.get(track_id)
            # Another actor may have the id of a removed one
            if node is not None and not torch.equal(node.own.mean_m, own.mean_m):
                self._actors.pop(track_id).frame.remove()
                node = None
            if node is None and present:
                node = self._actors[track_id] = self._added(graph, row, own)
            if node is not None:
                _place(node.frame, states.T_scene_actor[row])
                node.frame.visible = present
                if not present:
                    node.frame.position = HIDDEN_AT_M
        self.show_layers()

    def choose(self, track_id: int | None) -> None:
        """Highlight one actor."""
        self._chosen = track_id
        self.show_layers()

    def move(self, track_id: int, wxyz: np.ndarray, position: np.ndarray) -> None:
        """Move an actor in the scene, until it is shown again."""
        if track_id in self._actors:
            frame = self._actors[track_id].frame
            frame.wxyz, frame.position = wxyz, position

    def show_layers(self) -> None:
        """Show the layers that are switched on."""
        splats_at = SHOWN_AT_M if self.layers["splats"] else HIDDEN_AT_M
        if self._static is not None:
            self._static.position = splats_at
        for track_id, node in self._actors.items():
            chosen = track_id == self._chosen
            if node.splats is not None:
                node.splats.position = splats_at
            node.face.visible = node.edges.visible = self.layers["boxes"] or chosen
            node.face.opacity = CHOSEN_OPACITY if chosen else FACE_OPACITY
            node.label.visible = self.layers["ids"] or chosen

    def nudge(self) -> None:
        """Make browsers sort the splats again by an invisible movement.

        If several nodes arrive at once, browsers show only the first one until something moves.
        """
        self._root.position = self._root.position + np.array([0.0, 0.0, NUDGE_M])

    def _added(self, graph: SceneGraph, row: int, own: Gaussians) -> _ActorNode:
        track_id, size = int(graph.tracks.track_id[row]), graph.tracks.size_lwh[row].cpu()
        name, colour = f"{ROOT}/actors/{track_id}", palette.box_colour(int(graph.tracks.category[row]))
        rgb = palette.rgb255(colour)
        scene, shown = self._scene, thin_out(own, self.share, own.mean_m.new_zeros(1, 3))
        frame = scene.add_frame(name, show_axes=False)
        corners = box_corners(torch.zeros(3), size, torch.tensor(0.0))
        edges = corners[torch.tensor([*EDGES, (0, 5), (1, 4)])]  # With the diagonals of the front face
        face = scene.add_box(
            f"{name}/face",
            rgb,
            tuple(size.tolist()),
            opacity=FACE_OPACITY,
            side="double",
            cast_shadow=False,
            receive_shadow=False,
        )
        face.on_click(lambda _: self._on_click(track_id))
        return _ActorNode(
            frame=frame,
            splats=show_splats(scene, f"{name}/splats", shown) if len(shown.mean_m) else None,
            face=face,
            edges=scene.add_line_segments(
                f"{name}/edges", edges.numpy(), np.array(rgb), line_width=EDGE_WIDTH
            ),
            label=scene.add_label(
                f"{name}/id",
                str(track_id),
                position=(0.0, 0.0, 0.5 * float(size[2]) + 0.2),
                anchor="bottom-center",
                font_screen_scale=LABEL_SCALE,
            ),
            own=own,
        )


def _place(node: viser.SceneNodeHandle, T: Float[Tensor, "4 4"]) -> None:
    pose = T.detach().double().cpu().numpy()
    node.wxyz, node.position = SO3.from_matrix(pose[:3, :3]).wxyz, pose[:3, 3]
