"""DriveWorld: divergences in closed form, what is remembered, what imagination depends on."""

import dataclasses
import math
import weakref
from collections.abc import Callable

import pytest
import torch
from torch.distributions import Independent, Normal

from foredrive.errors import InputError
from foredrive.methods.blocks.backbone import BackboneConfig
from foredrive.methods.blocks.lift_splat import LiftSplatConfig
from foredrive.methods.driveworld import (
    DiagonalGaussian,
    DriveWorld,
    DriveWorldConfig,
    actions_of,
    balanced_kl,
    kl_divergence,
    motion_of,
)
from foredrive.methods.driveworld.planes import (
    PlanesToVolumeConfig,
    PlaneToVectorConfig,
    StaticSceneConfig,
    VectorToPlaneConfig,
    warp_plane,
)
from foredrive.methods.driveworld.state_space import MotionAwareNorm, StateSpace, StateSpaceConfig
from foredrive.methods.driveworld.task_prompt import PromptConfig
from foredrive.scene import Clip, Example, VoxelSpec, last_frames

SPEC = VoxelSpec(lower_m=(-4.0, -6.0, -1.0), voxel_m=1.0, shape_zyx=(2, 12, 10))
STATE, HISTORY, MEMORY, WIDTH, PAST = 12, 16, 5, 8, 2


SIZES = StateSpaceConfig(
    observation=10, state=STATE, history=HISTORY, objects=3, heads=2, memory=MEMORY, hidden=16
)


def states(**changes: bool) -> StateSpace:
    return StateSpace(dataclasses.replace(SIZES, **changes))


@pytest.fixture(scope="module")
def model() -> DriveWorld:
    torch.manual_seed(0)
    config = DriveWorldConfig(
        backbone=BackboneConfig(
            embedding_size=8, hidden_sizes=(8, 8), depths=(1, 1), layer_type="basic", stages=("stage2",)
        ),
        encoder=LiftSplatConfig(near_m=1.0, far_m=7.0, step_m=1.0),
        states=SIZES,
        channels=8,
        plane_channels=WIDTH,
        to_vector=PlaneToVectorConfig(hidden=4),
        from_vector=VectorToPlaneConfig(widths=(8, 8)),
        to_volume=PlanesToVolumeConfig(hidden=4),
        statics=StaticSceneConfig(channels=4),
        prompt=PromptConfig(expand=VectorToPlaneConfig(widths=(4, 4)), encoding=6, text_encoder="none"),
    )
    model = DriveWorld(config, SPEC, past_frames=PAST, dt_s=0.5, fetch=False).eval()
    assert model.prompt is not None
    torch.nn.init.normal_(model.prompt.encodings)
    return model


@pytest.fixture(scope="module")
def clip(make_example: Callable[..., Example]) -> Clip:
    """Two drives along an arc of 20 m radius at 4 m/s, turning left."""
    clip = make_example(past=PAST, future=0, spec=SPEC).clip
    step = motion_of(torch.tensor([[4.0, math.atan(2.86 / 20)]]), 0.5)[0].double()
    poses = [torch.eye(4, dtype=torch.float64)]
    for _ in range(PAST):
        poses.append(poses[-1] @ step)
    return dataclasses.replace(clip, T_world_ego=torch.stack(poses).expand(2, -1, -1, -1))


def test_divergence_is_that_of_torch() -> None:
    q, p = (DiagonalGaussian(torch.randn(3, 4), torch.rand(3, 4) + 0.2) for _ in range(2))
    theirs = torch.distributions.kl_divergence(
        Independent(Normal(q.mean, q.std), 1), Independent(Normal(p.mean, p.std), 1)
    )
    torch.testing.assert_close(kl_divergence(q, p), theirs)
    one = DiagonalGaussian(torch.tensor([1.0]), torch.tensor([2.0]))
    assert float(kl_divergence(one, DiagonalGaussian.standard(one.mean))) == pytest.approx(
        -math.log(2) + (4 + 1) / 2 - 0.5
    )


def test_balancing_divides_the_gradient_not_the_value() -> None:
    def parameters() -> tuple[torch.Tensor, torch.Tensor]:
        return torch.tensor([0.3, -1.0], requires_grad=True), torch.tensor([0.1, 0.7], requires_grad=True)

    std = torch.tensor([0.5, 1.5])
    plain, balanced = parameters(), parameters()
    value = kl_divergence(DiagonalGaussian(plain[0], std), DiagonalGaussian(plain[1], 2 * std))
    other = balanced_kl(DiagonalGaussian(balanced[0], std), DiagonalGaussian(balanced[1], 2 * std), 0.75)
    torch.testing.assert_close(value, other)
    value.backward()
    other.backward()
    torch.testing.assert_close(balanced[0].grad, 0.25 * plain[0].grad)
    torch.testing.assert_close(balanced[1].grad, 0.75 * plain[1].grad)


def test_samples_have_the_mean_and_spread_and_repeat() -> None:
    wide = DiagonalGaussian(torch.full((40_000, 1), 2.0), torch.full((40_000, 1), 0.5))
    drawn = wide.sample(torch.Generator().manual_seed(1))
    assert float(drawn.mean()) == pytest.approx(2.0, abs=4 * 0.5 / 200)
    assert float(drawn.std()) == pytest.approx(0.5, rel=0.02)
    assert torch.equal(drawn, wide.sample(torch.Generator().manual_seed(1)))
    assert float(DiagonalGaussian.from_output(torch.zeros(2), 0.1).std) == pytest.approx(1.1)


def test_motion_aware_normalisation_begins_as_plain_normalisation() -> None:
    norm, state = MotionAwareNorm(STATE, 3, 10.0), torch.randn(4, STATE)
    out = norm(state, torch.randn(4, 3, 2), torch.rand(4))
    torch.testing.assert_close(out, torch.nn.functional.layer_norm(state, (STATE,)))
    torch.nn.init.normal_(norm.gamma.weight)
    moved = norm(state, torch.randn(4, 3, 2), torch.rand(4))
    assert not torch.allclose(out, moved)


def test_only_what_is_remembered_is_recalled() -> None:
    torch.manual_seed(0)
    space = states()
    latent = space.initial(2, torch.device("cpu"))
    assert latent.memory_valid.sum(1).tolist() == [1, 1]
    nonsense = dataclasses.replace(
        latent, memory=torch.where(latent.memory_valid[..., None], latent.memory, torch.tensor(9.0))
    )
    assert space.recall is not None
    torch.testing.assert_close(space.recall(latent), space.recall(nonsense))
    for _ in range(MEMORY + 2):
        latent = space.transition(latent, torch.full((2,), 0.5))
    assert bool(latent.memory_valid.all())
    assert torch.equal(latent.memory[:, -1], latent.history)
    assert not (latent.memory == 0).all(-1).any()  # h_1 is forgotten


def test_without_its_parts_the_transition_is_a_plain_cell() -> None:
    space = states(memory_bank=False, motion_norm=False)
    latent = dataclasses.replace(space.initial(3, torch.device("cpu")), state=torch.randn(3, STATE))
    expected = space.cell(space.into(latent.state), latent.history)
    for dt_s in (0.1, 2.0):
        torch.testing.assert_close(space.transition(latent, torch.full((3,), dt_s)).history, expected)


@torch.no_grad()
def test_imagination_repeats_under_a_seed_and_goes_on_where_it_stopped(model: DriveWorld, clip: Clip) -> None:
    now = model.observe(clip)
    assert now.volume.shape == (2, 8, *SPEC.shape_zyx)
    means = model.imagine(now, 4)
    halves = model.imagine(now, 2)
    halves += model.imagine(halves[-1], 2)
    for once, twice in zip(means, halves, strict=True):
        torch.testing.assert_close(once.volume, twice.volume)
        torch.testing.assert_close(once.T_now_ego, twice.T_now_ego)
    drawn = [model.imagine(now, 2, generator=torch.Generator().manual_seed(seed)) for seed in (1, 1, 2)]
    assert torch.equal(drawn[0][1].volume, drawn[1][1].volume)
    assert not torch.allclose(drawn[0][1].volume, drawn[2][1].volume)
    assert {belief.state.shape for belief in means} == {now.state.shape}
    assert model.decode(means[0]).flow.shape == (2, 3, *SPEC.shape_zyx)


@torch.no_grad()
def test_imagining_on_and_on_keeps_nothing_of_what_was(model: DriveWorld, clip: Clip) -> None:
    belief, kept = model.observe(clip), []
    size = belief.state.shape
    for _ in range(3 * MEMORY):
        belief = model.imagine(belief, 1, generator=torch.Generator().manual_seed(0))[-1]
        kept += [weakref.ref(belief.volume), weakref.ref(belief.state)]
    assert belief.state.shape == size
    assert sum(reference() is not None for reference in kept) == 2


@torch.no_grad()
def test_a_task_has_features_of_its_own(model: DriveWorld, clip: Clip) -> None:
    now = model.observe(clip)
    torch.testing.assert_close(model.volume_for(now, "occupancy"), now.volume)
    assert not torch.allclose(model.volume_for(now, "planning"), now.volume)
    (later,) = model.imagine(now, 1)
    torch.testing.assert_close(model.volume_for(later, "occupancy"), later.volume)


@torch.no_grad()
def test_given_actions_move_the_vehicle_and_change_what_is_imagined(model: DriveWorld, clip: Clip) -> None:
    now = model.observe(clip)
    straight = torch.tensor([10.0, 0.0]).expand(2, 2, 2)
    ahead, standing = model.imagine(now, 2, straight), model.imagine(now, 2, torch.zeros(2, 2, 2))
    torch.testing.assert_close(ahead[1].T_now_ego[0, :3, 3], torch.tensor([10.0, 0.0, 0.0]))
    torch.testing.assert_close(standing[1].T_now_ego, torch.eye(4).expand(2, 4, 4))
    assert not torch.allclose(ahead[0].volume, standing[0].volume)
    policy = model.decode(now).action
    assert policy is not None
    own = model.imagine(now, 1)[0]
    torch.testing.assert_close(own.volume, model.imagine(now, 1, policy[:, None])[0].volume)
    with pytest.raises(InputError, match="asked for 3 with 2 given actions"):
        model.imagine(now, 3, straight)


def test_a_quarter_circle() -> None:
    """At a radius of 10 m it leads 10 m ahead and 10 m to the left."""
    steering, way_m = math.atan(2.86 / 10), 10 * math.pi / 2
    T = motion_of(torch.tensor([[way_m, steering]]), 1.0)[0]
    torch.testing.assert_close(T[:2, 3], torch.tensor([10.0, 10.0]), atol=1e-4, rtol=0)
    torch.testing.assert_close(T[:2, :2], torch.tensor([[0.0, -1.0], [1.0, 0.0]]), atol=1e-5, rtol=0)


def test_actions_are_those_that_led_from_pose_to_pose(clip: Clip) -> None:
    done = actions_of(clip)
    expected = torch.tensor([[4.0, math.atan(2.86 / 20)]] * PAST + [[0.0, 0.0]])
    torch.testing.assert_close(done[0], expected, atol=2e-3, rtol=0)
    unknown = dataclasses.replace(clip, ego_speed_valid=torch.zeros_like(clip.ego_speed_valid))
    torch.testing.assert_close(actions_of(unknown)[0], expected, atol=2e-3, rtol=0)
    faster = dataclasses.replace(clip, ego_speed_mps=torch.tensor([[3.0, 4.0, 5.0]] * 2))
    assert actions_of(faster)[0, :, 0].tolist() == [3.0, 4.0, 0.0]  # the speed at its beginning
    still = dataclasses.replace(clip, T_world_ego=clip.T_world_ego[:, :1].expand(-1, PAST + 1, -1, -1))
    assert actions_of(still)[..., 1].abs().max() == 0


def test_training_sees_every_frame_and_reaches_every_part(model: DriveWorld, clip: Clip) -> None:
    seen = model.unroll(model.lift_frames(last_frames(clip, PAST)), 2, torch.Generator().manual_seed(0))
    assert (len(seen.beliefs), len(seen.posteriors), len(seen.priors)) == (PAST + 3, PAST + 1, PAST + 1)
    assert seen.actions.shape == (2, PAST + 3, 2)
    assert seen.velocities_mps.shape == (2, PAST + 1, 3, 2)
    first = kl_divergence(seen.posteriors[0], seen.priors[0])
    assert torch.equal(seen.priors[0].std, torch.ones_like(seen.priors[0].std))
    occupancy = sum(model.decode(belief).occupancy_logit.square().mean() for belief in seen.beliefs)
    divergence = sum(
        balanced_kl(q, p, 0.75).mean() for q, p in zip(seen.posteriors, seen.priors, strict=True)
    )
    flow = model.decode(seen.beliefs[0]).flow
    assert flow is not None
    model.zero_grad()
    (occupancy + divergence + flow.sum() + first.sum()).backward()
    without = {name for name, parameter in model.named_parameters() if parameter.grad is None}
    assert without == set()
    assert not any(name.endswith("encodings") for name, _ in model.named_parameters())  # the text is frozen
    repeated = model.unroll(model.lift_frames(last_frames(clip, PAST)), 2, torch.Generator().manual_seed(0))
    assert torch.equal(repeated.beliefs[-1].volume, seen.beliefs[-1].volume)


@torch.no_grad()
def test_statics_are_handed_on_without_warping(model: DriveWorld, clip: Clip) -> None:
    now = model.observe(clip)
    later = model.imagine(now, 3)
    assert now.statics is not None
    assert all(torch.equal(belief.statics, now.statics) for belief in later)


def test_a_clip_that_shows_the_future_or_too_little_is_refused(
    model: DriveWorld, clip: Clip, make_example: Callable[..., Example]
) -> None:
    with pytest.raises(InputError, match="observed"):
        model.observe(make_example(past=PAST, future=1, spec=SPEC).clip)
    with pytest.raises(InputError, match="2 frames before now"):
        model.observe(clip.frames(slice(1, None)))


def test_a_carried_plane_shows_what_lies_there() -> None:
    plane = torch.zeros(1, 1, *SPEC.shape_zyx[1:])  # 12 rows of y from -6 m, 10 columns of x from -4 m
    plane[0, 0, 6, 7] = 1.0  # the cell around x 3.5 m, y 0.5 m
    ahead = motion_of(torch.tensor([[4.0, 0.0]]), 0.5)  # 2 m straight on
    (where,) = warp_plane(plane, ahead, SPEC)[0, 0].nonzero().tolist()
    assert where == [6, 5]
    left = torch.eye(4)[None].clone()
    left[0, :2, :2] = torch.tensor([[0.0, -1.0], [1.0, 0.0]])  # facing left: what was ahead lies to the right
    carried = warp_plane(plane, left, SPEC)
    assert carried[0, 0, 2, 4] == pytest.approx(1.0)  # x 0.5 m, y -3.5 m
    assert carried.sum() == pytest.approx(1.0)


def test_carried_statics_move_under_the_actions_alone(model: DriveWorld, clip: Clip) -> None:
    now = model.observe(clip)
    stand, go = torch.zeros(2, 2, 2), torch.tensor([4.0, 0.0]).expand(2, 2, 2)
    as_it_is = [model.imagine(now, 2, actions)[-1].volume for actions in (stand, go)]
    model.warp_statics = True
    try:
        torch.testing.assert_close(model.observe(clip).volume, now.volume)
        standing, going = (model.imagine(now, 2, actions)[-1] for actions in (stand, go))
        torch.testing.assert_close(model.volume_for(going, "occupancy"), going.volume)
        seen = model.lift_frames(last_frames(clip, PAST))
        first, *_, last = model.unroll(seen, 0, None).beliefs  # statics of now
        torch.testing.assert_close(last.volume, now.volume)
    finally:
        model.warp_statics = False
    torch.testing.assert_close(standing.volume, as_it_is[0])
    assert not torch.allclose(going.volume, as_it_is[1])
    assert going.statics is now.statics  # carried when looked at, not twice
    assert not torch.allclose(first.volume, model.unroll(seen, 0, None).beliefs[0].volume)


@torch.no_grad()
def test_a_model_of_three_prompts_reads_other_tasks_under_a_near_one(model: DriveWorld, clip: Clip) -> None:
    """As models do that were trained before each task had its prompt."""
    now = model.observe(clip)
    assert model.prompt is not None
    assert model.prompt.prompts == ("occupancy", "forecast", "planning")
    for task in ("detection", "tracking", "map"):
        torch.testing.assert_close(model.volume_for(now, task), now.volume)
    assert not torch.allclose(model.volume_for(now, "motion"), now.volume)
