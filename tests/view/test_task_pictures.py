"""Pictures of what task heads find beside the truth: what is shown, what it is called, in which colours."""

import dataclasses

import numpy as np
import pytest
import torch

from foredrive.runs import ExamplePrediction
from foredrive.scene import Category, Example
from foredrive.scene.agent_futures import AgentFutures
from foredrive.scene.agents import Agents, MapLines
from foredrive.scene.map_elements import ElementKind, MapElements
from foredrive.scene.semantics import VOXEL_CLASSES, SemanticVoxels
from foredrive.scene.task_truth import TaskTruth
from foredrive.tasks.predictor import Prediction
from foredrive.view import palette
from foredrive.view.example_panel import draw_example
from foredrive.view.task_pictures import columns_rgb, found_agents, true_scene

CLASSES = VOXEL_CLASSES["occ3d"]
ROAD, CAR, FREE = CLASSES.index("driveable_surface"), CLASSES.index("car"), len(CLASSES) - 1


def agents(scores: list[float], tracks: list[int], p: list[float]) -> Agents:
    """Cars along x, 6 m apart, each with modes of the given probabilities that drive on at 2 m/s."""
    count, steps = len(scores), torch.arange(1, 13.0)
    centre = torch.stack([6.0 * torch.arange(count), torch.zeros(count), torch.full((count,), 0.8)], dim=-1)
    path = torch.stack([steps, torch.zeros(12)], dim=-1)
    return Agents(
        centre=centre,
        size_lwh=torch.tensor([4.0, 2.0, 1.6]).expand(count, 3),
        yaw=torch.zeros(count),
        velocity=torch.tensor([2.0, 0.0]).expand(count, 2),
        category=torch.full((count,), int(Category.CAR)),
        score=torch.tensor(scores),
        attribute=torch.zeros(count, dtype=torch.long),
        track_id=torch.tensor(tracks),
        future_xy=centre[:, None, None, :2] + path.expand(count, len(p), 12, 2),
        log_prob=torch.tensor(p).log().expand(count, len(p)),
    )


def test_boxes_are_named_by_their_track_or_else_by_their_score() -> None:
    found = found_agents(agents([0.9, 0.2, 0.456], [17, 3, -1], [0.7, 0.2, 0.1]))
    assert list(found.names) == ["17", ".46"]
    assert [[round(p, 3) for _, p in modes] for modes in found.futures] == [[0.7], [0.7]]
    assert found.boxes.centre[:, 0].tolist() == [0.0, 12.0]


def test_the_likeliest_future_is_always_drawn() -> None:
    even = [1 / 6] * 6
    assert [len(modes) for modes in found_agents(agents([0.9], [1], even)).futures] == [6]
    two = found_agents(agents([0.9], [1], [0.4, 0.35, 0.25 - 1e-3, 1e-3])).futures
    assert [round(p, 2) for _, p in two[0]] == [0.4, 0.35]


def test_columns_show_their_highest_voxel() -> None:
    voxels = np.full((3, 1, 3), FREE, dtype=np.uint8)
    voxels[0] = ROAD
    voxels[1, 0, 1] = CAR
    voxels[0, 0, 2] = FREE
    rgb = columns_rgb(voxels, "occ3d")
    expected = [palette.VOXEL_COLOURS["driveable_surface"], palette.VOXEL_COLOURS["car"], palette.KNOWN_FREE]
    assert rgb[0].tolist() == [list(palette.rgb255(colour)) for colour in expected]
    assert set(palette.VOXEL_COLOURS) >= {*CLASSES[:-1], *VOXEL_CLASSES["openocc"][:-1]}


@pytest.fixture
def shown(example: Example) -> ExamplePrediction:
    """Truth and findings of all heads on the street."""
    clip, spec = example.clip, example.occupancy.spec
    boxes = clip.boxes[clip.now]
    xy = boxes.centre[:, None, :2] + torch.zeros(len(boxes.yaw), 12, 2)
    valid = torch.ones(xy.shape[:2], dtype=torch.bool)
    line = torch.tensor([[[-10.0, 2.0], [10.0, 2.0]], [[-10.0, 0.0], [10.0, 0.0]]])
    kinds = torch.tensor([ElementKind.DIVIDER, ElementKind.CENTRELINE])
    index = torch.full(spec.shape_zyx, ROAD, dtype=torch.uint8)
    known = torch.ones(spec.shape_zyx, dtype=torch.bool)
    truth = TaskTruth(
        futures=AgentFutures(xy, torch.zeros(xy.shape[:2]), valid, 0.5),
        elements=MapElements(line, torch.ones(2, 2, dtype=torch.bool), kinds, torch.tensor(True)),
        semantics=SemanticVoxels(spec, "occ3d", index, known, known, known),
    )
    found = agents([0.9, 0.5], [4, -1], [0.6, 0.4])
    tasks = Prediction(
        agents=found.map_tensors(lambda tensor: tensor[None]),
        map_lines=MapLines(line[None, :1], kinds[None, :1], torch.tensor([[0.8]])),
        semantics=torch.full_like(index, CAR)[None],
    )
    frames = clip.t_s.shape[0] - clip.now
    return ExamplePrediction(
        example=dataclasses.replace(example, truth=truth, key=("street@1577836802250000",)),
        occupied=torch.zeros(frames, *spec.shape_zyx, dtype=torch.bool),
        rendered=None,
        volume=torch.randn(6, *spec.shape_zyx, generator=torch.Generator().manual_seed(0)),
        plan=clip.future,
        tasks=tasks,
    )


def test_the_truth_has_track_ids_and_no_centrelines(shown: ExamplePrediction) -> None:
    scene, clip = true_scene(shown), shown.example.clip
    boxes = clip.boxes[clip.now]
    assert scene.agents is not None
    assert list(scene.agents.names) == [str(track) for track in boxes.track_id[boxes.valid].tolist()]
    assert scene.lines is not None
    assert [kind for kind, _ in scene.lines] == [ElementKind.DIVIDER]


def test_a_panel_has_truth_and_finding_side_by_side(shown: ExamplePrediction) -> None:
    rows = draw_example(shown).tasks
    assert [len(row) for row in rows] == [2, 2, 2]
    for one, other in rows:
        assert (one.width, one.height) == (other.width, other.height)
        assert one.source != other.source
    assert "front" in rows[1][0].caption
    assert draw_example(dataclasses.replace(shown, tasks=None)).tasks == []
