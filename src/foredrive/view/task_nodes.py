"""What task heads find as nodes of a 3-D scene: boxes with names and futures, map elements."""

import numpy as np
import torch
import viser

from foredrive.geometry.boxes import EDGES, box_corners
from foredrive.scene.agents import Agents, MapLines
from foredrive.scene.map_elements import ElementKind
from foredrive.view import palette
from foredrive.view.scene_nodes import clear
from foredrive.view.task_pictures import MIN_SCORE, STILL_M, found_agents

BOXES, MAP = "/found boxes", "/found map"
LIFT_M = 0.1
"""Height of lines above the ground, m."""


def show_agents(scene: viser.SceneApi, agents: Agents | None) -> None:
    """Draw likely road users of an unbatched frame as thin boxes, each with its name and likely futures."""
    clear(scene, BOXES)
    found = None if agents is None else found_agents(agents)
    if found is None or not len(found.names):
        return
    boxes = found.boxes
    corners = box_corners(boxes.centre, boxes.size_lwh, boxes.yaw)
    edges = torch.tensor([*EDGES, (0, 5), (1, 4)])
    pieces, colours = [], []
    for n, kind in enumerate(boxes.category.tolist()):
        colour = palette.rgb255(palette.box_colour(kind))
        x, y, z = boxes.centre[n].tolist()
        lines = [corners[n][edges].numpy()]
        for xy, _ in found.futures[n]:
            if np.linalg.norm(xy[-1] - (x, y)) >= STILL_M:
                path = np.concatenate([[(x, y)], xy])
                path = np.concatenate([path, np.full((len(path), 1), z)], axis=1)
                lines.append(np.stack([path[:-1], path[1:]], axis=1))
        pieces += lines
        colours += [np.tile(np.array(colour), (len(each), 2, 1)) for each in lines]
    scene.add_frame(BOXES, show_axes=False)
    scene.add_line_segments(f"{BOXES}/lines", np.concatenate(pieces), np.concatenate(colours), line_width=1.5)
    tops = boxes.centre[:, 2] + 0.5 * boxes.size_lwh[:, 2] + 0.3
    for n, name in enumerate(found.names):
        x, y, _ = boxes.centre[n].tolist()
        scene.add_label(f"{BOXES}/name {n}", name, position=(x, y, float(tops[n])))


def show_lines(scene: viser.SceneApi, lines: MapLines | None) -> None:
    """Draw likely map elements of an unbatched frame on the ground."""
    kept = None if lines is None else lines[lines.score >= MIN_SCORE]
    if kept is None or not len(kept.score):
        return clear(scene, MAP)
    points = torch.nn.functional.pad(kept.points, (0, 1), value=LIFT_M)
    pieces = torch.stack([points[:, :-1], points[:, 1:]], dim=2)
    colours = np.array(
        [palette.rgb255(palette.ELEMENT_COLOURS[ElementKind(kind)]) for kind in kept.kind.tolist()]
    )
    each = np.broadcast_to(colours[:, None, None], (*pieces.shape[:3], 3)).reshape(-1, 2, 3)
    scene.add_line_segments(MAP, pieces.flatten(0, 1).numpy(), each, line_width=4.0)
    return None
