"""Results of task heads next to the ground truth: from above, in a camera, and as semantic voxels."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from numpy import ndarray
from torch import Tensor

from foredrive.runs import ExamplePrediction
from foredrive.scene import Boxes, Category, Clip, VoxelSpec
from foredrive.scene.agents import Agents
from foredrive.scene.boxes import unlabelled
from foredrive.scene.map_elements import ElementKind
from foredrive.scene.semantics import VOXEL_CLASSES, Taxonomy
from foredrive.tasks.maps.lines import CLASSES
from foredrive.tasks.predictor import Prediction
from foredrive.view import palette
from foredrive.view.bev import draw_boxes, draw_ego, start_bev, with_legend
from foredrive.view.html import Picture, picture
from foredrive.view.image_drawing import Camera, draw_boxes_on_image, resize

MIN_SCORE = 0.3
"""Boxes and lines with a lower score are not drawn."""
MIN_PROBABILITY = 0.25
"""Of an agent's futures, the likeliest is drawn, and others with a probability of at least this."""
STILL_M = 1.0
"""Futures that end nearer to their box are not drawn."""
FIGURE_IN, DPI = (5.6, 6.3), 110
PIXELS_PER_VOXEL_ROW = 560


@dataclass(frozen=True)
class SeenAgents:
    """Road users to draw: true ones, or found ones."""

    boxes: Boxes
    """Unbatched."""
    names: Sequence[str]
    """Text beside each box."""
    futures: Sequence[Sequence[tuple[Float[ndarray, "S 2"], float]]]
    """Futures of each box with their probability."""


@dataclass(frozen=True)
class SeenScene:
    """One side of a comparison: the truth, or the results of a model. None: this side does not exist."""

    agents: SeenAgents | None = None
    lines: Sequence[tuple[ElementKind, Float[ndarray, "V 2"]]] | None = None
    voxels: UInt8[ndarray, "Z Y X"] | None = None


def true_scene(shown: ExamplePrediction) -> SeenScene:
    """Return the ground truth of an example."""
    clip, truth = shown.example.clip, shown.example.truth
    agents = None
    if bool(clip.boxes_valid[clip.now]):
        boxes = clip.boxes[clip.now]
        futures: list[list[tuple[ndarray, float]]] = [[] for _ in boxes.valid]
        if truth is not None and truth.futures is not None:
            rows = zip(truth.futures.xy, truth.futures.valid, strict=True)
            for n, (xy, valid) in enumerate(rows):
                futures[n] = [(xy[valid].numpy(), 1.0)] if bool(valid.any()) else []
        names = [str(track) for track in boxes.track_id.tolist()]
        agents = _kept(SeenAgents(boxes, names, futures), boxes.valid)
    lines = None
    if truth is not None and truth.elements is not None and bool(truth.elements.known):
        elements = zip(
            truth.elements.kind.tolist(), truth.elements.vertices, truth.elements.valid, strict=True
        )
        lines = [
            (ElementKind(kind), line[valid].numpy()) for kind, line, valid in elements if kind in CLASSES
        ]
    semantics = None if truth is None else truth.semantics
    voxels = None if semantics is None or not bool(semantics.known.any()) else semantics.index.numpy()
    return SeenScene(agents, lines, voxels)


def found_scene(prediction: Prediction) -> SeenScene:
    """Return the results of the heads for the first item of a batch."""
    agents = None if prediction.agents is None else found_agents(prediction.agents[0].to("cpu"))
    lines = None
    if prediction.map_lines is not None:
        map_lines = prediction.map_lines[0].to("cpu")
        elements = zip(
            map_lines.kind.tolist(), map_lines.points.numpy(), map_lines.score.tolist(), strict=True
        )
        lines = [(ElementKind(kind), line) for kind, line, score in elements if score >= MIN_SCORE]
    voxels = None if prediction.semantics is None else prediction.semantics[0].cpu().numpy()
    return SeenScene(agents, lines, voxels)


def found_agents(agents: Agents) -> SeenAgents:
    """Return the likely agents of an unbatched frame; they are named by their score, or by their track."""
    agents = agents[agents.score >= MIN_SCORE]
    count = len(agents.score)
    boxes = Boxes(
        centre=agents.centre,
        size_lwh=agents.size_lwh,
        yaw=agents.yaw,
        velocity=agents.velocity,
        track_id=agents.track_id,
        category=agents.category,
        valid=torch.ones(count, dtype=torch.bool),
        **unlabelled(count),
    )
    identities = zip(agents.track_id.tolist(), agents.score.tolist(), strict=True)
    names = [str(track) if track >= 0 else f"{score:.2f}".lstrip("0") for track, score in identities]
    futures: list[list[tuple[ndarray, float]]] = [[] for _ in names]
    if agents.future_xy is not None and agents.log_prob is not None:
        for n, (modes, log_prob) in enumerate(zip(agents.future_xy, agents.log_prob, strict=True)):
            alternatives = zip(modes.numpy(), log_prob.exp().tolist(), strict=True)
            # The likeliest future is kept however small its probability is
            likeliest = float(log_prob.exp().max())
            futures[n] = [(mode, p) for mode, p in alternatives if p >= min(MIN_PROBABILITY, likeliest)]
    return SeenAgents(boxes, names, futures)


def _kept(agents: SeenAgents, which: Bool[Tensor, "M"]) -> SeenAgents:
    rows = which.nonzero()[:, 0].tolist()
    return SeenAgents(agents.boxes[which], [agents.names[n] for n in rows], [agents.futures[n] for n in rows])


def task_pictures(shown: ExamplePrediction, front: int | None) -> list[list[Picture]]:
    """Return rows of two pictures, truth and prediction; nothing for a model without task heads.

    Args:
        shown: the example.
        front: the camera to draw boxes in; None: no image is shown.
    """
    if shown.tasks is None:
        return []
    true, predicted = true_scene(shown), found_scene(shown.tasks)
    spec, clip = shown.example.occupancy.spec, shown.example.clip
    rows = []
    if predicted.agents is not None or predicted.lines is not None:
        rows.append(
            [
                picture(
                    scene_picture(true, spec), "Truth: boxes with track ids and 6 s, map elements", "png"
                ),
                picture(scene_picture(predicted, spec), f"Found, scores of {MIN_SCORE} and more", "png"),
            ]
        )
    if front is not None and predicted.agents is not None:
        titles = (f"{clip.rig.names[front]}: true boxes", "Found boxes")
        rows.append(
            [
                picture(camera_boxes(clip, front, None if side.agents is None else side.agents.boxes), title)
                for side, title in zip((true, predicted), titles, strict=True)
            ]
        )
    semantics = None if shown.example.truth is None else shown.example.truth.semantics
    if predicted.voxels is not None and semantics is not None:
        captions = ("True classes, the highest voxel of each column", "Predicted classes")
        sides = (true.voxels, predicted.voxels)
        rows.append(
            [
                picture(voxels_picture(voxels, semantics.taxonomy, spec), caption, "png")
                for voxels, caption in zip(sides, captions, strict=True)
                if voxels is not None
            ]
        )
    return rows


def scene_picture(scene: SeenScene, spec: VoxelSpec) -> UInt8[ndarray, "H W 3"]:
    """Draw road users with names and futures, and map elements, from above; the model's grid is framed."""
    figure = Figure(figsize=FIGURE_IN, dpi=DPI, facecolor=palette.GROUND)
    ax = figure.add_axes((0.125, 0.17, 0.855, 0.79))
    # The view is square and centred on the ego vehicle, the grid may not be
    reach_m = max(*(abs(corner) for corner in (*spec.lower_m[:2], *spec.upper_m[:2]))) + 2.0
    start_bev(ax, reach_m)
    (x0, y0, _), (x1, y1, _) = spec.lower_m, spec.upper_m
    ax.add_patch(Rectangle((y0, x0), y1 - y0, x1 - x0, fill=False, edgecolor=palette.FAINT, linewidth=0.6))
    for kind, line in scene.lines or ():
        ax.plot(line[:, 1], line[:, 0], color=palette.ELEMENT_COLOURS[kind], linewidth=1.5, zorder=2)
    if scene.agents is not None:
        draw_agents(ax, scene.agents, reach_m)
    draw_ego(ax)
    return with_legend(figure, _legend(scene))


def draw_agents(ax: Axes, agents: SeenAgents, reach_m: float) -> None:
    """Draw footprints with their names, and futures with their probability as opacity.

    A name that would cover that of a box nearer to the ego vehicle is left out.
    """
    draw_boxes(ax, agents.boxes)
    centres, kinds = agents.boxes.centre.numpy(), agents.boxes.category.tolist()
    named: list[tuple[float, float]] = []
    for n in np.linalg.norm(centres[:, :2], axis=1).argsort().tolist():
        (x, y, _), name, futures = centres[n], agents.names[n], agents.futures[n]
        colour = palette.box_colour(kinds[n])
        for xy, probability in futures:
            if np.linalg.norm(xy[-1] - (x, y)) < STILL_M:
                continue
            path = np.concatenate([[(x, y)], xy])[:, ::-1]
            alpha = 0.25 + 0.75 * probability
            ax.add_collection(LineCollection([path], color=colour, linewidth=1.1, alpha=alpha, zorder=3.4))
            ax.plot(*path[1:].T, ".", color=colour, markersize=2.2, alpha=alpha, zorder=3.5)
        # The extent of a name, m: names are written along y, which is horizontal
        free = all(abs(x - other_x) > 2.5 or abs(y - other_y) > 6.0 for other_x, other_y in named)
        if free and max(abs(x), abs(y)) < reach_m - 2:
            named.append((x, y))
            ax.annotate(
                name,
                (y, x),
                (5, 5),
                textcoords="offset points",
                color=colour,
                fontsize=6.5,
                zorder=6,
                clip_on=True,
            )


def _legend(scene: SeenScene) -> list[Artist]:
    handles: list[Artist] = [Patch(facecolor=palette.EGO, label="ego vehicle")]
    kinds = dict.fromkeys(kind for kind, _ in scene.lines or ())
    handles += [
        Line2D([], [], color=palette.ELEMENT_COLOURS[kind], label=kind.name.lower()) for kind in sorted(kinds)
    ]
    if scene.agents is not None:
        present = sorted(set(scene.agents.boxes.category.tolist()))
        handles += [Patch(color=palette.box_colour(c), label=palette.label(Category(c))) for c in present]
    return handles[:12]


def camera_boxes(clip: Clip, index: int, boxes: Boxes | None) -> UInt8[ndarray, "H W 3"]:
    """Draw boxes of the ego frame at now into a camera's image."""
    image = clip.images[clip.now, index].permute(1, 2, 0).numpy()
    size_hw = (round(PIXELS_PER_VOXEL_ROW * image.shape[0] / image.shape[1]), PIXELS_PER_VOXEL_ROW)
    camera = Camera.of(clip.rig[clip.now], index).resized(size_hw)
    drawn = resize(image, size_hw)
    return drawn if boxes is None else draw_boxes_on_image(drawn, boxes, camera)


def voxels_picture(
    voxels: UInt8[ndarray, "Z Y X"], taxonomy: Taxonomy, spec: VoxelSpec
) -> UInt8[ndarray, "H W 3"]:
    """Draw the highest occupied voxel of each column from above, x up and y to the left, with a legend."""
    names = VOXEL_CLASSES[taxonomy]
    figure = Figure(figsize=FIGURE_IN, dpi=DPI, facecolor=palette.GROUND)
    ax = figure.add_axes((0.125, 0.17, 0.855, 0.79))
    start_bev(ax, max(abs(corner) for corner in (*spec.lower_m[:2], *spec.upper_m[:2])))
    (x0, y0, _), (x1, y1, _) = spec.lower_m, spec.upper_m
    # Rows are x and columns are y; the reversed horizontal axis puts left on the left
    rgb = columns_rgb(voxels, taxonomy).swapaxes(0, 1)
    ax.imshow(rgb, origin="lower", extent=(y0, y1, x0, x1), interpolation="nearest", zorder=1)
    ax.set(xlim=(y1, y0), ylim=(x0, x1))
    draw_ego(ax)
    present = [name for n, name in enumerate(names[:-1]) if bool((voxels == n).any())]
    handles = [Patch(color=palette.VOXEL_COLOURS[n], label=n.replace("_", " ")) for n in present]
    return with_legend(figure, handles)


def columns_rgb(voxels: UInt8[ndarray, "Z Y X"], taxonomy: Taxonomy) -> UInt8[ndarray, "Y X 3"]:
    """Return the colour of the highest occupied voxel of each column, or that of free space."""
    colours = voxel_colours(taxonomy)
    occupied = voxels != len(colours) - 1
    # The first occupied voxel from above; in an empty column it is the topmost, which is free
    top = len(voxels) - 1 - occupied[::-1].argmax(axis=0)
    y, x = np.indices(top.shape)
    return colours[voxels[top, y, x]]


def voxel_colours(taxonomy: Taxonomy) -> UInt8[ndarray, "C 3"]:
    """Return the colours of classes, free space last."""
    names = VOXEL_CLASSES[taxonomy][:-1]
    rgb = [palette.rgb255(palette.VOXEL_COLOURS[name]) for name in names]
    return np.array([*rgb, palette.rgb255(palette.KNOWN_FREE)], dtype=np.uint8)
