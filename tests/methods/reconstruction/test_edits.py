"""Edits by hand, and from their file."""

import dataclasses
import math
from pathlib import Path

import pytest
import torch
from test_scene_graph import graph_of, two_actors

from foredrive.errors import InputError
from foredrive.methods.reconstruction.edits import (
    DriveStraight,
    Duplicate,
    Edit,
    Insert,
    Move,
    Remove,
    ShiftEgo,
    apply_edits,
    load_edits,
    save_edits,
    unused_id,
)
from foredrive.methods.reconstruction.scene_graph import ANOTHER, STATIC, SceneGraph
from foredrive.methods.splatad.content import gaussians_of
from foredrive.methods.splatad.placing import place_actors


def scene() -> SceneGraph:
    return graph_of([[5.0, 5, 5], [1.0, 0, 0], [0.0, 0, 0]], [STATIC, 0, 1], two_actors())


def test_moving_is_in_the_actors_own_frame() -> None:
    edited = apply_edits(scene(), [Move(7, offset_m=(1.0, 0.0, 0.0))]).graph
    way = edited.tracks.T_scene_actor[0, :, :2, 3]
    assert torch.allclose(way, torch.tensor([[1.0, 0], [4, 1]]), atol=1e-6)
    assert torch.equal(scene().tracks.T_scene_actor[1], edited.tracks.T_scene_actor[1])


def test_removing_takes_the_gaussians_along() -> None:
    edited = apply_edits(scene(), [Remove(7)]).graph
    assert edited.tracks.track_id.tolist() == [11]
    assert gaussians_of(edited).actor.tolist() == [STATIC, 0]
    assert place_actors(edited, 0.0).source.tolist() == []


def test_a_copy_is_another_actor() -> None:
    edited = apply_edits(scene(), [Duplicate(7, copy=8, offset_m=(0.0, 3.0, 0.0)), Remove(7)]).graph
    assert edited.tracks.track_id.tolist() == [11, 8]
    assert edited.looks_like.tolist() == [11, 7]
    again = apply_edits(edited, [Duplicate(8, copy=9)]).graph
    assert again.looks_like.tolist() == [11, 7, 7]
    placed = place_actors(edited, 0.0).gaussians
    assert torch.allclose(placed.mean_m[-1], torch.tensor([1.0, 3, 1]))


def test_an_inserted_actor_stands_on_the_same_ground() -> None:
    edits = [Insert("other", actor=11, copy=20, follows=7, yaw_rad=math.pi)]
    edited = apply_edits(scene(), edits, lambda run: scene()).graph
    pose = edited.tracks.T_scene_actor[2, 0]
    assert torch.allclose(pose[:3, 3], torch.tensor([0.0, 0, 1]))  # both are 2 m high
    assert torch.allclose(pose[:2, :2], -torch.eye(2), atol=1e-6)
    assert edited.tracks.category[2] == scene().tracks.category[1]
    assert edited.looks_like.tolist() == [7, 11, ANOTHER]


def test_a_sent_copy_goes_straight_on_all_the_time() -> None:
    """At 2 m/s to the left through a point at 1 s, wherever its original is then."""
    sent = DriveStraight(
        7, copy=9, at_m=(10.0, 4.0, 1.0), at_s=1.0, velocity_mps=(0.0, 2.0, 0.0), yaw_rad=math.pi / 2
    )
    edited = apply_edits(scene(), [sent]).graph
    tracks = edited.tracks
    assert tracks.track_id.tolist() == [7, 11, 9]
    assert bool(tracks.present[2].all())
    since_s = tracks.t_s - 1.0
    assert torch.allclose(tracks.T_scene_actor[2, :, 1, 3], 4.0 + 2.0 * since_s)
    assert torch.allclose(tracks.T_scene_actor[2, :, :2, 0], torch.tensor([0.0, 1.0]), atol=1e-6)
    assert torch.equal(tracks.T_scene_actor[:2], scene().tracks.T_scene_actor)
    placed = place_actors(edited, float(tracks.t_s[0])).gaussians.mean_m[-1]
    ahead_m = 1.0  # of its middle its Gaussian is
    at_first = torch.tensor([10.0, 4.0 + 2.0 * float(since_s[0]) + ahead_m, 1.0])
    assert torch.allclose(placed, at_first, atol=1e-5)


def test_the_ego_vehicle_is_shifted_in_its_own_frame() -> None:
    edits = [ShiftEgo((0.0, 2.0, 0.0)), ShiftEgo((1.0, 0.0, 0.0), yaw_rad=0.1)]
    T = apply_edits(scene(), edits).T_ego_shifted
    assert torch.allclose(T[:3, 3], torch.tensor([1.0, 2, 0]))


def test_edits_from_a_file_do_the_same(tmp_path: Path) -> None:
    edits: list[Edit] = [Move(7, (1.0, 2.0, 0.0), 0.3), Duplicate(11, 12, (0.0, 1.0, 0.0)), Remove(11)]
    edits.append(DriveStraight(7, 13, (5.0, 0.0, 1.0), 0.5, (-1.0, 0.0, 0.0)))
    save_edits(edits, tmp_path / "edits.json")
    again = load_edits(tmp_path / "edits.json")
    assert again == edits
    first, second = apply_edits(scene(), edits).graph, apply_edits(scene(), again).graph
    assert torch.equal(first.tracks.T_scene_actor, second.tracks.T_scene_actor)
    assert torch.equal(gaussians_of(first).gaussians.mean_m, gaussians_of(second).gaussians.mean_m)


@pytest.mark.parametrize(
    ("edit", "told"),
    [
        (Remove(3), r"no actor 3; there are: 7, 11"),
        (Move(3), r"no actor 3"),
        (Duplicate(7, copy=11), r"there is an actor 11 already"),
        (Insert("other", 7, 8, 7), r"no run can be opened"),
    ],
)
def test_what_cannot_be_done_is_told(edit: Edit, told: str) -> None:
    with pytest.raises(InputError, match=told):
        apply_edits(scene(), [edit])


def test_what_stands_is_in_the_way_and_no_part_to_be_edited() -> None:
    """11 belongs to the static part: its box stays, and its number stays taken."""
    tracks = two_actors()
    own, stands = tracks.only(torch.tensor([True, False])), tracks.only(torch.tensor([False, True]))
    graph = dataclasses.replace(graph_of([[5.0, 5, 5], [1.0, 0, 0]], [STATIC, 0], own), obstacles=stands)
    for edit in (Remove(11), Move(11), Duplicate(11, copy=12), Insert("other", 7, 12, follows=11)):
        with pytest.raises(InputError, match=r"11 is no actor of its own.*--set actors=true moves_m=0"):
            apply_edits(graph, [edit], lambda run: graph)
    with pytest.raises(InputError, match="there is an actor 11 already"):
        apply_edits(graph, [Duplicate(7, copy=11)])
    assert unused_id(graph) == 12
    edited = apply_edits(graph, [Duplicate(7, copy=12), Remove(7)]).graph
    assert edited.tracks.track_id.tolist() == [12]
    assert edited.all_tracks.track_id.tolist() == [12, 11]


def test_a_file_of_something_else_is_told(tmp_path: Path) -> None:
    file = tmp_path / "edits.json"
    file.write_text('[{"kind": "remove", "actor": "red"}]')
    with pytest.raises(InputError, match=r"not a list of edits: 0\.remove\.actor"):
        load_edits(file)
    with pytest.raises(InputError, match="cannot be read"):
        load_edits(tmp_path / "nothing.json")


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ('[{"kind": "move", "actor": 7, "offset_m": [NaN, 0, 0]}]', "0.move.offset_m.0: .*finite number"),
        ('[{"kind": "move", "actor": 7, "yaw_rad": Infinity}]', "0.move.yaw_rad: .*finite number"),
        ('[{"kind": "shift_ego", "offset_m": [0, 0, 1e999]}]', "0.shift_ego.offset_m.2: .*finite number"),
        ("[" + ", ".join(['{"kind": "remove", "actor": 7}'] * 1001) + "]", "1,001 edits; there may be 1,000"),
    ],
)
def test_edits_to_nowhere_and_without_end_are_refused(content: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "edits.json").write_text(content)
    with pytest.raises(InputError, match=said):
        load_edits(tmp_path / "edits.json")
