"""NeMo's parts on cases whose answers are known, and the agent as a whole."""

import dataclasses
import math
from collections.abc import Callable

import pytest
import torch

from foredrive.errors import InputError
from foredrive.geometry.se3 import exp_se3
from foredrive.methods.blocks.bev import BevConfig
from foredrive.methods.blocks.lifting import project_to_cameras
from foredrive.methods.nemo import MotionConfig, MotionFlow, Nemo, RendererConfig, VolumeRenderer
from foredrive.methods.nemo.ablations import nemo_ablations
from foredrive.methods.nemo.motion import Motion
from foredrive.methods.nemo.objective import NemoStage
from foredrive.methods.nemo.recipes import NemoRecipe, nemo_base, nemo_tiny
from foredrive.methods.planner.agent import PlanningAgent
from foredrive.ops.volume import sample_volume_reference, warp_volume
from foredrive.runs.build import build_agent, build_objective
from foredrive.scene import Command, Example, VoxelSpec, last_frames
from foredrive.scene.ego_motion import continued_motion

SPEC = VoxelSpec(lower_m=(-8.0, -8.0, -1.0), voxel_m=1.0, shape_zyx=(4, 16, 16))


def small_recipe() -> NemoRecipe:
    """nemo_tiny on a grid small enough for unit tests."""
    recipe = nemo_tiny()
    return dataclasses.replace(
        recipe,
        clips=dataclasses.replace(recipe.clips, voxels=SPEC),
        model=dataclasses.replace(
            recipe.model,
            channels=16,
            renderer=dataclasses.replace(recipe.model.renderer, samples=16, far_m=12.0),
        ),
    )


@pytest.fixture
def agent() -> PlanningAgent:
    torch.manual_seed(0)
    return build_agent(small_recipe()).eval()


@pytest.fixture
def example(make_example: Callable[..., Example]) -> Example:
    return make_example(spec=SPEC, batch=2, past=1, future=2, cameras=4)


def test_a_voxel_straight_ahead_is_seen_by_the_front_camera_alone(
    agent: PlanningAgent, example: Example
) -> None:
    seen = example.clip.observed().frames([-1])
    rig = seen.rig.map_tensors(lambda tensor: tensor.flatten(0, 1))
    uv, visible = project_to_cameras(agent.world_model.encoder.centres_m, rig, seen.image_valid.flatten(0, 1))
    centres = agent.world_model.encoder.centres_m
    ahead = int((centres - torch.tensor([6.5, 0.5, 1.5])).norm(dim=-1).argmin())
    assert visible[0, :, ahead].tolist() == [True, False, False, False]
    # Camera at 1.6 m height, focal length 40 px, principal point (32, 16), image 32×64.
    expected = torch.tensor([(32 - 40 * 0.5 / 6.5) / 64, (16 + 40 * 0.1 / 6.5) / 32])
    torch.testing.assert_close(uv[0, 0, ahead], expected, atol=1e-4, rtol=0)


def test_a_missing_image_is_not_looked_at(agent: PlanningAgent, example: Example) -> None:
    clip = example.clip.observed()
    masked = clip.image_valid.clone()
    masked[:, :, 0] = False
    other = clip.images.clone()
    other[:, :, 0] = 255 - other[:, :, 0]
    with torch.no_grad():
        a = agent.world_model.observe(dataclasses.replace(clip, image_valid=masked)).volume
        b = agent.world_model.observe(dataclasses.replace(clip, image_valid=masked, images=other)).volume
        unmasked = agent.world_model.observe(dataclasses.replace(clip, images=other)).volume
    torch.testing.assert_close(a, b)
    assert not torch.allclose(a, unmasked)


def test_nothing_after_now_reaches_the_plan(agent: PlanningAgent, example: Example) -> None:
    clip = example.clip
    images = clip.images.clone()
    images[:, clip.now + 1 :] = 0
    pose = clip.T_world_ego.clone()
    pose[:, clip.now + 1 :, 0, 3] += 100
    changed = dataclasses.replace(clip, images=images, T_world_ego=pose)
    torch.testing.assert_close(agent.act(clip.observed()).xy, agent.act(changed.observed()).xy)
    with pytest.raises(InputError, match=r"observed\(\)"):
        agent.world_model.observe(clip)


def test_too_few_frames_are_refused(agent: PlanningAgent, example: Example) -> None:
    with pytest.raises(InputError, match="needs 1 frames before now"):
        agent.world_model.observe(example.clip.observed().frames([-1]))


def test_without_motion_the_future_is_the_present(agent: PlanningAgent, example: Example) -> None:
    """Motion starts at zero (its last layers do), so imagining must not change anything."""
    with torch.no_grad():
        belief = agent.world_model.observe(example.clip.observed())
        futures = agent.world_model.imagine(belief, 2)
    for future in futures:
        torch.testing.assert_close(future.volume, belief.volume, atol=1e-5, rtol=0)
        torch.testing.assert_close(future.T_now_ego, torch.eye(4).expand(2, 4, 4))
    with pytest.raises(InputError, match="1 to 2 steps"):
        agent.world_model.imagine(belief, 3)
    with pytest.raises(InputError, match="takes no actions"):
        agent.world_model.imagine(belief, 1, torch.zeros(2, 1, 2))


def test_driving_forward_moves_the_volume_back(agent: PlanningAgent, example: Example) -> None:
    """Two metres ahead per step: what was at x + 2 is at x, and the poses chain up."""
    motion = agent.world_model.motion
    with torch.no_grad():
        motion.rigid[-1].bias.view(2, 6)[:, 0] = 2.0 / 0.1
        belief = agent.world_model.observe(example.clip.observed())
        first, second = agent.world_model.imagine(belief, 2)
    torch.testing.assert_close(first.volume[..., :-2], belief.volume[..., 2:], atol=1e-4, rtol=0)
    torch.testing.assert_close(second.volume[..., :-4], belief.volume[..., 4:], atol=1e-4, rtol=0)
    assert second.T_now_ego is not None
    torch.testing.assert_close(second.T_now_ego[0, :3, 3], torch.tensor([4.0, 0.0, 0.0]))


def test_rays_stop_at_a_wall_and_pass_through_air() -> None:
    renderer = VolumeRenderer(RendererConfig(near_m=0.5, far_m=7.5, samples=28, hidden=8), SPEC, channels=2)
    logit = torch.full((1, *SPEC.shape_zyx), -30.0)
    logit[..., 12] = 30.0  # opaque from x = 4 to 5 m
    feature = torch.zeros(1, 2, *SPEC.shape_zyx)
    direction = torch.tensor([[[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]])
    rays = renderer(feature, logit, torch.zeros(1, 2, 3) + torch.tensor([0.0, 0.2, 0.7]), direction)
    assert rays.alpha[0, 0] > 0.999
    assert 3.5 < rays.range_m[0, 0] < 4.5
    assert rays.alpha[0, 1] < 1e-3
    assert rays.range_m[0, 1] == pytest.approx(7.5, abs=1e-2)


def test_what_passes_through_shows_the_background() -> None:
    renderer = VolumeRenderer(RendererConfig(near_m=0.5, far_m=7.5, samples=8, hidden=8), SPEC, channels=2)
    with torch.no_grad():
        renderer.background.copy_(torch.tensor([3.0, -1.0]))
    empty = torch.full((1, *SPEC.shape_zyx), -30.0)
    rays = renderer(
        torch.ones(1, 2, *SPEC.shape_zyx), empty, torch.zeros(1, 1, 3), torch.tensor([[[1.0, 0.0, 0.0]]])
    )
    torch.testing.assert_close(
        rays.rgb[0, 0], renderer.recon(renderer.background).sigmoid(), atol=1e-4, rtol=0
    )


def test_an_unknown_command_is_not_taken_for_a_known_one(agent: PlanningAgent, example: Example) -> None:
    clip = example.clip.observed()
    with torch.no_grad():
        plans = {
            command: agent.act(dataclasses.replace(clip, command=torch.full((2,), int(command)))).xy
            for command in Command
        }
        unknown = [
            agent.act(
                dataclasses.replace(
                    clip,
                    command=torch.full((2,), int(command)),
                    command_valid=torch.zeros(2, dtype=torch.bool),
                )
            ).xy
            for command in Command
        ]
    assert not torch.allclose(plans[Command.LEFT], plans[Command.RIGHT])
    torch.testing.assert_close(unknown[0], unknown[1])
    assert not any(torch.allclose(unknown[0], plan) for plan in plans.values())


ROWS = nemo_ablations(small_recipe(), BevConfig(width=24, heads=4, points=2, pillars=2, layers=1))


@pytest.mark.parametrize("row", ROWS)
@pytest.mark.parametrize("stage", ["pretrain", "finetune"])
def test_what_is_trained_is_what_gets_a_gradient(row: str, stage: str, example: Example) -> None:
    recipe = ROWS[row]
    chosen: NemoStage | None = getattr(recipe, stage)
    if chosen is None:
        return
    torch.manual_seed(0)
    objective = build_objective(recipe, chosen, build_agent(recipe))
    motion = objective.agent.world_model.motion
    for last in (motion.flow[-1], motion.rigid[-1]):  # at exactly zero they pass no gradient on
        torch.nn.init.normal_(last.weight, std=1e-3)
    losses = objective(example, torch.Generator().manual_seed(0))
    losses["loss"].backward()
    trained = {name for name, parameter in objective.named_parameters() if parameter.requires_grad}
    reached = {
        name
        for name, parameter in objective.named_parameters()
        if parameter.grad is not None and parameter.grad.isfinite().all()
    }
    assert trained == reached
    assert all(math.isfinite(value.item()) for value in losses.values())
    assert ("agent.planner.plan" in trained) == (stage == "finetune") == ("wpts" in losses)
    part = {name.split(".")[2] for name in reached if name.startswith("agent.world_model.")}
    weights, imagines = chosen.weights, stage == "finetune" and objective.agent.planner.imagined_frames > 0
    expected = {"backbone", "encoder"}
    expected |= {"motion"} if chosen.imagine or imagines else set()
    expected |= {"occupancy"} if weights.occ or weights.recon else set()
    expected |= {"renderer"} if weights.recon else set()
    assert part == expected


def test_the_rows_of_the_tables() -> None:
    """What each leaves out, in the paper's own terms."""
    full = small_recipe()
    assert ROWS[full.name] == full
    scratch, base = ROWS["nemo_tiny_scratch"], ROWS["nemo_tiny_base"]
    assert scratch.pretrain is None
    assert base.pretrain == full.pretrain
    assert (scratch.model, scratch.finetune) == (base.model, base.finetune)
    assert base.finetune.weights == dataclasses.replace(full.finetune.weights, recon=0.0, occ=0.0)
    futures = {name.removeprefix("nemo_tiny_"): row.planner.future for name, row in ROWS.items()}
    assert {name for name, future in futures.items() if future == "attention"} == {"nemo_tiny", "attention"}
    assert {name for name, future in futures.items() if future == "concatenation"} == {"concatenation"}
    lacks = {
        name: [what for what, there in (("image", w.recon), ("occupancy", w.occ)) if not there]
        for name, row in ROWS.items()
        if row.pretrain is not None and (w := row.pretrain.weights)
    }
    assert lacks["nemo_tiny_no_image"] == lacks["nemo_tiny_bev"] == ["image"]
    assert lacks["nemo_tiny_no_occupancy"] == ["occupancy"]
    assert not lacks["nemo_tiny_no_flow"]
    assert ROWS["nemo_tiny_no_flow"].pretrain.imagine is False
    assert {row.model.encoder.kind for name, row in ROWS.items() if "bev" in name} == {"bev"}


@pytest.mark.parametrize("row", ["nemo_tiny", "nemo_tiny_bev"])
def test_computing_again_changes_nothing_but_memory(row: str, example: Example) -> None:
    found = []
    for checkpoint in (False, True):
        model = ROWS[row].model
        parts = {
            "backbone": dataclasses.replace(model.backbone, checkpoint=checkpoint),
            "encoder": dataclasses.replace(model.encoder, checkpoint=checkpoint),
        }
        recipe = dataclasses.replace(ROWS[row], model=dataclasses.replace(model, **parts))
        torch.manual_seed(0)
        assert recipe.pretrain is not None
        objective = build_objective(recipe, recipe.pretrain, build_agent(recipe))
        objective(example, torch.Generator().manual_seed(0))["loss"].backward()
        found.append({name: p.grad for name, p in objective.named_parameters() if p.grad is not None})
    kept, again = found
    assert kept.keys() == again.keys()
    for name, gradient in kept.items():
        torch.testing.assert_close(again[name], gradient, atol=1e-6, rtol=1e-4, msg=name)


def test_the_same_generator_gives_the_same_losses(example: Example) -> None:
    recipe = small_recipe()
    objective = build_objective(recipe, recipe.pretrain, build_agent(recipe)).eval()
    a, b, c = (objective(example, torch.Generator().manual_seed(seed))["l1"].item() for seed in (1, 1, 2))
    assert a == b != c


def test_nemo_base_has_the_papers_size() -> None:
    recipe = nemo_base()
    with torch.device("meta"):
        agent = build_agent(recipe, fetch=False)
    assert agent.world_model.encoder.query.shape == (200 * 200 * 16, 64)
    assert agent.planner.plan.shape == (256,)
    parameters = sum(parameter.numel() for parameter in agent.parameters())
    assert 69e6 < parameters < 70e6
    schedule = recipe.pretrain.schedule
    assert (schedule.lr, schedule.weight_decay, schedule.epochs) == (2e-4, 1e-2, 10)
    weights = recipe.finetune.weights
    assert (weights.scal, weights.bce, weights.wpts, weights.recon, weights.occ) == (10, 1, 1, 0.5, 0.5)


def test_each_step_has_its_own_flow_and_the_poses_chain_in_order(
    agent: PlanningAgent, example: Example
) -> None:
    """Two steps that turn and drive, and two different flows, against a reading of the volume by hand."""
    world = agent.world_model
    belief = world.observe(example.clip.observed())
    grid = torch.zeros(2, 2, 3, *SPEC.shape_zyx)
    grid[:, 0, 0], grid[:, 1, 1] = 1.0, 2.0  # everything came from x + 1 m, then from y + 2 m
    T = torch.stack([exp_se3(torch.tensor(xi)) for xi in ([2.0, 0, 0, 0, 0, 0.5], [1.0, 0.5, 0, 0, 0, -0.2])])
    motion = Motion(flow=grid, T_prev_next=T.expand(2, 2, 4, 4))
    with torch.no_grad(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(world.motion, "forward", lambda volumes: motion)
        first, second = world.imagine(belief, 2)
    for future, T_now_ego, flow_m, step_m in (
        (first, T[0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0]),
        (second, T[0] @ T[1], [1.0, 2.0, 0.0], [0.0, 2.0, 0.0]),
    ):
        place = torch.tensor([1.5, 0.5, 0.5])
        source_m = T_now_ego[:3, :3] @ place + T_now_ego[:3, 3] + torch.tensor(flow_m)
        expected = sample_volume_reference(
            belief.volume.detach().permute(0, 2, 3, 4, 1),
            (source_m - torch.tensor(SPEC.lower_m)).expand(2, 1, 3),
        )
        z, y, x = (int(i) for i in (place - torch.tensor(SPEC.lower_m)).floor().flip(0))
        torch.testing.assert_close(future.volume[:, :, z, y, x], expected[:, 0], atol=1e-4, rtol=0)
        assert future.T_now_ego is not None
        assert future.flow_mps is not None
        torch.testing.assert_close(future.T_now_ego[0], T_now_ego)
        velocity = -T_now_ego[:3, :3].T @ torch.tensor(step_m) / world.dt_s
        torch.testing.assert_close(future.flow_mps[0, :, z, y, x], velocity, atol=1e-4, rtol=0)


def mover_error(speed_vox: int) -> float:
    """Learn the flow of blocks, seen from a vehicle that drives a known number of voxels a step.

    Channel 0 stands still, channels 1 and 2 move by 2 voxels to the left and to the right. The error is the
    mean over the voxels that hold a moving block, or would if it stood still.
    """
    torch.manual_seed(0)
    shape, lower_m = (1, 24, 40), (0.0, -12.0, 0.0)
    module = MotionFlow(MotionConfig(hidden=12), channels=3, frames=1, steps=1)
    optimizer = torch.optim.Adam(module.flow.parameters(), lr=1e-2)
    T_now_next = exp_se3(torch.tensor([float(speed_vox), 0, 0, 0, 0, 0])).expand(4, 4, 4)
    errors = []
    for _ in range(100):
        volume, after = torch.zeros(2, 4, 3, *shape)
        for channel, moved in enumerate((0, 2, -2)):
            for item in range(4):
                x, y = int(torch.randint(12, 34, ())), int(torch.randint(3, 17, ()))
                volume[item, channel, 0, y : y + 4, x : x + 4] = 1
                after[item, channel, 0, y + moved : y + moved + 4, x - speed_vox : x - speed_vox + 4] = 1
        flow = module.flow(volume).unflatten(1, (1, 3))[:, 0]
        error = (warp_volume(volume, flow, T_now_next, lower_m, 1.0) - after).square()
        unmoved = volume.roll(-speed_vox, -1)
        errors.append(error.detach()[:, 1:][(after + unmoved)[:, 1:] > 0].mean())
        optimizer.zero_grad()
        error.mean().mul(100).backward()
        optimizer.step()
    return float(torch.stack(errors[-30:]).mean())


def test_what_moves_is_found_however_fast_the_ego_vehicle_drives() -> None:
    """Flow is predicted on the grid of now. Looked up elsewhere, it would fail beyond the network's reach."""
    at_rest = mover_error(0)
    assert at_rest < 0.25
    assert mover_error(5) < 1.2 * at_rest
    assert mover_error(10) < 1.2 * at_rest


@pytest.mark.parametrize("shape_yx", [(24, 32), (23, 31)])
def test_flow_from_a_coarser_grid_is_that_of_columns_that_are_all_alike(shape_yx: tuple[int, int]) -> None:
    """Away from the border, convolutions over equal columns do not depend on the size of a column."""
    volumes = torch.randn(1, 2, 3, 4, 1, 1).expand(-1, -1, -1, -1, *shape_yx)
    flows = []
    for stride in (1, 2):
        torch.manual_seed(0)
        module = MotionFlow(MotionConfig(hidden=8, stride=stride), channels=3, frames=2, steps=2)
        for parameter in module.parameters():
            torch.nn.init.normal_(parameter, std=0.1)
        flows.append(module(volumes).flow)
    assert flows[1].shape == (1, 2, 3, 4, *shape_yx)
    inner = (..., slice(8, -8), slice(8, -8))
    torch.testing.assert_close(flows[0][inner], flows[1][inner], rtol=1e-4, atol=1e-5)


def test_imagination_starts_from_the_measured_ego_motion(agent: PlanningAgent, example: Example) -> None:
    """Untrained, it moves the volume as the vehicle goes on, and adds each step's own feature."""
    model = small_recipe().model
    config = dataclasses.replace(
        model, motion=dataclasses.replace(model.motion, ego="measured"), step_features=True
    )
    world = Nemo(config, SPEC, past_frames=1, max_steps=2, dt_s=0.5).eval()
    assert world.step_features is not None
    observed = example.clip.observed()
    T_prev_next = continued_motion(last_frames(observed, 1), 2)
    with torch.no_grad():
        world.step_features[0] = 1.0
        belief = world.observe(observed)
        first, second = world.imagine(belief, 2)
        assert belief.T_prev_next is not None
        torch.testing.assert_close(belief.T_prev_next, T_prev_next)
        standing = torch.zeros(len(belief.volume), 3, *SPEC.shape_zyx)
        T_now_second = T_prev_next[:, 0] @ T_prev_next[:, 1]
        expected = warp_volume(belief.volume, standing, T_now_second, SPEC.lower_m, SPEC.voxel_m)
    torch.testing.assert_close(second.T_now_ego, T_now_second, atol=1e-5, rtol=0)
    torch.testing.assert_close(second.volume, expected, atol=1e-4, rtol=0)
    torch.testing.assert_close(
        first.volume,
        1.0 + warp_volume(belief.volume, standing, T_prev_next[:, 0], SPEC.lower_m, SPEC.voxel_m),
        atol=1e-4,
        rtol=0,
    )
