"""Agents that are carried from frame to frame: their motion by hand, and streaming as in training."""

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from foredrive.errors import InputError
from foredrive.geometry.se3 import inverse_se3, matrix_from_yaw
from foredrive.heads.agents_head import (
    AGENT_CLASSES,
    AgentHeadConfig,
    AgentSet,
    CarriedConfig,
    take_proposals,
)
from foredrive.heads.carried import CarriedAgents, carry, frame_steps, lineage_of, moved
from foredrive.heads.decoder import DecoderConfig
from foredrive.heads.detection_network import BoxSet
from foredrive.heads.heads import HeadOutput, TaskHeads, TaskHeadsConfig, TaskVolume
from foredrive.heads.motion_head import MotionConfig
from foredrive.runs.evaluate.predict import DriveFollower
from foredrive.scene import Attribute, VoxelSpec

SPEC = VoxelSpec(lower_m=(-8.0, -8.0, -1.0), voxel_m=1.0, shape_zyx=(2, 16, 16))
FRAMES, SEQUENCES = 3, 2


def agents(xy: list[tuple[float, float]], velocity: tuple[float, float] = (0.0, 0.0)) -> AgentSet:
    """A batch of one: agents that head along x."""
    n = len(xy)
    logits = torch.zeros(1, n, len(AGENT_CLASSES) + 1)
    logits[0, :, 0] = torch.arange(n).float()
    boxes = BoxSet(
        logits=logits,
        mean=torch.tensor([[[x, y, 0.5, 1.2, 0.4, 0.4] for x, y in xy]]),
        log_std=torch.zeros(1, n, 6),
        heading=torch.tensor([0.0, 1.0]).expand(1, n, 2),
        log_std_yaw=torch.zeros(1, n),
    )
    return AgentSet(
        boxes,
        torch.tensor(velocity).expand(1, n, 2),
        torch.zeros(1, n, len(Attribute)),
        query=torch.arange(n).float().view(1, n, 1),
    )


def test_an_agent_moves_by_its_velocity_and_against_the_ego_motion() -> None:
    """It drives on from x = 10 by 2 m; the ego vehicle drives 2 m and turns left: it is to the right then."""
    T_before_now = matrix_from_yaw(torch.tensor([math.pi / 2]), torch.tensor([[2.0, 0.0, 0.0]]))
    found = moved(agents([(10.0, 0.0)], (4.0, 0.0)), inverse_se3(T_before_now), 0.5)
    torch.testing.assert_close(found.boxes.mean[0, 0, :3], torch.tensor([0.0, -10.0, 0.5]))
    torch.testing.assert_close(found.velocity[0, 0], torch.tensor([0.0, -4.0]))
    torch.testing.assert_close(found.boxes.heading[0, 0], torch.tensor([-1.0, 0.0]))  # sine, cosine of -90°
    torch.testing.assert_close(found.boxes.mean[0, 0, 3:], torch.tensor([1.2, 0.4, 0.4]))


def poses(count: int) -> Tensor:
    """Poses far from the origin of the world, turning."""
    yaw = 0.3 * torch.arange(count, dtype=torch.float64)
    xyz = torch.tensor([3e5, -2e5, 10.0], dtype=torch.float64) + yaw[:, None] * torch.tensor([5.0, 2.0, 0.1])
    return matrix_from_yaw(yaw, xyz)


def test_steps_are_within_a_sequence_and_begin_with_none() -> None:
    T_world_ego = poses(SEQUENCES * FRAMES)
    steps = frame_steps(T_world_ego, FRAMES, 0.5)
    assert steps.T_now_before.shape == (SEQUENCES, FRAMES, 4, 4)
    torch.testing.assert_close(steps.T_now_before[:, 0], torch.eye(4).expand(SEQUENCES, 4, 4))
    landmark = T_world_ego[0] @ torch.tensor([1.0, 2.0, 3.0, 1.0], dtype=torch.float64)
    for item in (1, 2, 4, 5):
        before, now = (inverse_se3(T_world_ego[n]) @ landmark for n in (item - 1, item))
        step = steps.T_now_before[item // FRAMES, item % FRAMES]
        torch.testing.assert_close(step @ before.float(), now.float(), atol=1e-4, rtol=0)


def test_the_highest_ranks_are_carried_and_a_hidden_agent_keeps_a_share_of_its_rank() -> None:
    first = agents([(0.0, 0.0), (1.0, 0.0), (2.0, 0.0)])
    lineage = lineage_of(first, None, 0.6)
    score = first.best_class()[0][0]
    torch.testing.assert_close(lineage.rank[0], score)
    carried = carry(first, lineage, 2, torch.eye(4)[None], 0.5)
    assert carried.lineage.source.tolist() == [[2, 1]]
    assert carried.agents.boxes.mean[0, :, 0].tolist() == [2.0, 1.0]
    hidden = agents([(9.0, 0.0), (9.0, 0.0), (9.0, 0.0)])  # the first has the lowest score now
    after = lineage_of(hidden, carried, 0.6)
    assert after.source.tolist() == [[2, 1, -1]]
    assert after.rank[0, 0].item() == pytest.approx(0.6 * score[2].item())
    assert after.rank[0, 2].item() == pytest.approx(score[2].item())


def test_queries_carry_gradients_and_boxes_do_not() -> None:
    found = agents([(0.0, 0.0), (1.0, 0.0)])
    found.query.requires_grad_()
    found.boxes.mean.requires_grad_()
    carried = carry(found, lineage_of(found, None, 0.6), 1, torch.eye(4)[None], 0.5)
    assert carried.agents.query is not None
    assert carried.agents.query.requires_grad
    assert not carried.agents.boxes.mean.requires_grad


def test_carried_agents_take_the_nearest_proposals_in_turn() -> None:
    """The first takes the one that the second is nearer to; the third finds none within 2 m. Two items."""
    carried_m = torch.tensor([[[0.0, 0.0], [1.0, 0.0], [9.0, 9.0]]])
    proposals_m = torch.tensor([[[20.0, 0.0], [1.2, 0.0], [-5.0, 0.0], [2.5, 0.0], [7.0, 7.0]]])
    taken, rest = take_proposals(
        torch.cat([carried_m, carried_m + 100.0]), torch.cat([proposals_m, proposals_m]), 2.0
    )
    assert taken.tolist() == [[1, 3, -1], [-1, -1, -1]]
    assert rest.tolist() == [[0, 2], [0, 1]]


def test_the_object_of_a_taken_proposal_is_not_proposed_again_as_another_class() -> None:
    """The second proposal lies 0.4 m from the one that is taken: it comes last, if all are needed."""
    proposals_m = torch.tensor([[[0.1, 0.0], [0.5, 0.0], [1.5, 0.0], [9.0, 0.0]]])
    carried_m = torch.tensor([[[0.0, 0.0]]])
    taken, rest = take_proposals(carried_m, proposals_m, 2.0)
    assert taken.tolist() == [[0]]
    assert rest.tolist() == [[2, 3, 1]]
    both, left = take_proposals(carried_m.expand(1, 2, 2), proposals_m, 2.0)
    assert both.tolist() == [[0, 2]]
    assert left.tolist() == [[3, 1]]


def heads(carried: CarriedConfig) -> TaskHeads:
    decoder = DecoderConfig(layers=2, heads=2)
    config = TaskHeadsConfig(
        width=16,
        max_cells=8,
        agents=AgentHeadConfig(
            queries=8, decoder=decoder, motion=MotionConfig(2, 4, 0.5, decoder), carried=carried
        ),
        elements=None,
        raster=None,
        voxels=None,
    )
    torch.manual_seed(0)
    return TaskHeads(config, SPEC, channels=3).eval()


def frame_volumes() -> TaskVolume:
    rng = torch.Generator().manual_seed(1)
    volume = torch.randn(SEQUENCES * FRAMES, 3, *SPEC.shape_zyx, generator=rng)
    return TaskVolume(volume, volume.flip(-1), torch.eye(4).expand(len(volume), 4, 4))


def test_a_drive_frame_by_frame_gives_the_agents_of_a_training_sequence() -> None:
    """Also with other sequences in the batch. Identities follow the lineage, and each log begins anew."""
    config = CarriedConfig(agents=3, born=0.0, frames=FRAMES)
    module, volume, T_world_ego = heads(config), frame_volumes(), poses(SEQUENCES * FRAMES)
    follower = DriveFollower(config)
    with torch.no_grad():
        whole = module({"tracking": volume, "motion": volume}, module.config.steps(T_world_ego))
        assert whole.agents is not None
        assert whole.lineage is not None
        ids = []
        for item in range(SEQUENCES * FRAMES):
            one = volume[item : item + 1]

            def perceive(carried: CarriedAgents | None, one: TaskVolume = one) -> HeadOutput:
                return module({"tracking": one, "motion": one}, carried=carried)

            key = f"drive_{item // FRAMES}@{500_000 * (item + 1)}"
            found, track_id = follower.step(perceive, key, T_world_ego[item])
            assert found.agents is not None
            for name in ("mean", "logits", "heading"):
                expected = getattr(whole.agents[-1].boxes, name)[item]
                torch.testing.assert_close(
                    getattr(found.agents[-1].boxes, name)[0], expected, atol=1e-4, rtol=1e-4
                )
            torch.testing.assert_close(
                found.agents[-1].future_xy[0], whole.agents[-1].future_xy[item], atol=1e-3, rtol=1e-4
            )
            ids.append(track_id[0])
    for item in range(SEQUENCES * FRAMES):
        source = whole.lineage.source[item]
        if item % FRAMES == 0:
            assert (source == -1).all()
            assert not set(ids[item].tolist()) & {n for before in ids[:item] for n in before.tolist()}
        else:
            assert (source[:3] >= 0).all()
            assert ids[item][:3].tolist() == ids[item - 1][source[:3]].tolist()
            assert len(set(ids[item].tolist())) == 8


def test_a_low_score_gets_no_identity() -> None:
    config = CarriedConfig(agents=3, born=0.9)
    follower, volume = DriveFollower(config), frame_volumes()[:1]
    module = heads(config)
    with torch.no_grad():
        _, track_id = follower.step(
            lambda carried: module({"tracking": volume, "motion": volume}, carried=carried),
            "a@0",
            poses(1)[0],
        )
    assert (track_id == -1).all()


def test_agents_that_are_not_finite_are_not_carried_on() -> None:
    """The frame after a failed one begins anew, as the first of a drive does."""
    config = CarriedConfig(agents=3, born=0.0)
    follower, module, T_world_ego = DriveFollower(config), heads(config), poses(3)
    volume = frame_volumes()
    found = []
    with torch.no_grad():
        for item in range(3):
            now = volume.now[item : item + 1] * (torch.nan if item == 1 else 1.0)
            one = dataclasses.replace(volume[item : item + 1], now=now)

            def perceive(carried: CarriedAgents | None, one: TaskVolume = one) -> HeadOutput:
                return module({"tracking": one, "motion": one}, carried=carried)

            found.append(follower.step(perceive, f"drive@{500_000 * item}", T_world_ego[item]))
        last = volume[2:3]
        alone = module({"tracking": last, "motion": last})
    assert found[2][0].agents[-1].boxes.mean.equal(alone.agents[-1].boxes.mean)
    assert not set(found[2][1][0].tolist()) & set(found[0][1][0].tolist())


@pytest.mark.parametrize(
    ("change", "said"), [({"agents": 8}, "the head has 8 queries"), ({"frames": 1}, "2 frames")]
)
def test_impossible_numbers_are_one_line(change: dict[str, int], said: str) -> None:
    with pytest.raises(InputError, match=said):
        heads(dataclasses.replace(CarriedConfig(agents=3), **change))


@pytest.mark.parametrize(("hidden", "same"), [(2, True), (6, False)])
def test_an_identity_waits_for_a_hidden_agent_and_ends(hidden: int, same: bool) -> None:
    """A rank of 0.94 is 0.34 after two hidden frames, and below 0.1 after five."""
    config = CarriedConfig(agents=1, decay=0.6, born=0.1)
    follower = DriveFollower(config)

    def frame(score_logit: float, number: int) -> list[int]:
        found = agents([(5.0, 0.0), (-5.0, 0.0)])
        logits = torch.full_like(found.boxes.logits, -9.0)
        logits[..., -1] = 0.0
        logits[0, 0, 0] = score_logit
        found = dataclasses.replace(found, boxes=dataclasses.replace(found.boxes, logits=logits))

        def perceive(carried: CarriedAgents | None) -> HeadOutput:
            return HeadOutput(agents=[found], lineage=lineage_of(found, carried, config.decay))

        track_id = follower.step(perceive, f"a@{500_000 * number}", poses(1)[0])[1]
        return track_id[0].tolist()

    assert frame(5.0, 0) == [0, -1]
    for number in range(hidden):
        assert frame(-9.0, 1 + number) == [-1, -1]
    assert frame(5.0, 1 + hidden) == [0 if same else 1, -1]
