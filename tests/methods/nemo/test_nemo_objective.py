"""NeMo's objective: rays, perceptual networks, weights."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from miniature import miniature
from safetensors.torch import save_file

from foredrive.data.augmentation import AugmentConfig, mirrored
from foredrive.errors import InputError
from foredrive.geometry.projection import project
from foredrive.geometry.se3 import inverse_se3, transform_points
from foredrive.methods.blocks.training_rays import averaged_rays
from foredrive.methods.blocks.vgg import VggFeatures
from foredrive.methods.nemo.objective import NemoObjective, NemoStage
from foredrive.methods.nemo.sampling import ImaginationSampling
from foredrive.runs.build import build_agent, build_objective
from foredrive.runs.recipes.known import find_recipe
from foredrive.scene import Example

RECIPE = miniature()
SPEC = RECIPE.clips.voxels


@pytest.fixture
def example(make_example: Callable[..., Example]) -> Example:
    return make_example(spec=SPEC)


def vgg_file(path: Path) -> Path:
    """Small random weights of VGG-16 in a file."""
    widths = [3, 64, 64, 128, 128, 256, 256, 256, 512, 512, 512]
    rng, state = torch.Generator().manual_seed(0), {}
    for layer, source, target in zip((0, 2, 5, 7, 10, 12, 14, 17, 19, 21), widths, widths[1:], strict=False):
        state[f"features.{layer}.weight"] = torch.randn(target, source, 3, 3, generator=rng) * 0.05
        state[f"features.{layer}.bias"] = torch.zeros(target)
    save_file(state, path)
    return path


@pytest.mark.parametrize("seed", range(4))
def test_an_averaged_ray_goes_through_the_middle_of_the_pixels_that_it_shows(
    seed: int, example: Example
) -> None:
    clip, stride = example.clip, 8
    height, width = clip.rig.size_hw
    row, column = torch.randint(stride, (2,), generator=torch.Generator().manual_seed(seed)).tolist()
    rays = averaged_rays(clip, 1, stride, torch.Generator().manual_seed(seed))
    b, c, _, h, w = rays.rgb.shape
    assert (h, w) == ((height - row) // stride, (width - column) // stride)
    block = clip.images[1, 1, 1, :, row + 8 : row + 16, column + 16 : column + 24].double()
    torch.testing.assert_close(rays.rgb[1, 1, :, 1, 2].double(), block.mean(dim=(1, 2)) / 255)
    ahead = (rays.origin + 7.0 * rays.direction).view(b, c, h * w, 3)
    rig = clip.rig
    in_camera = transform_points(inverse_se3(rig.T_ego_cam[:, 1]), ahead)
    uv, _, _ = project(in_camera, rig.K[:, 1], rig.dist[:, 1], rig.size_hw)
    middle = torch.tensor([column + 16 + 4.0, row + 8 + 4.0])
    torch.testing.assert_close(uv[1, 1].view(h, w, 2)[1, 2], middle, atol=1e-3, rtol=0)


@pytest.mark.parametrize("name", ["tower", "vgg"])
@pytest.mark.parametrize("pixels", ["thinned", "averaged"])
def test_both_networks_teach_the_renderer(name: str, pixels: str, example: Example, tmp_path: Path) -> None:
    perceptual = "tower" if name == "tower" else str(vgg_file(tmp_path / "vgg.safetensors"))
    stage = dataclasses.replace(RECIPE.pretrain, pixels=pixels, perceptual=perceptual)
    stage = dataclasses.replace(stage, weights=dataclasses.replace(stage.weights, occ=0.0))
    torch.manual_seed(0)
    objective = build_objective(RECIPE, stage, build_agent(RECIPE)).train()
    losses = objective(example, torch.Generator().manual_seed(0))
    expected = stage.weights.recon * (losses["l1"] + stage.weights.perc * losses["perc"])
    torch.testing.assert_close(losses["loss"], expected)
    losses["perc"].backward()
    assert all(p.grad is not None and p.grad.any() for p in objective.agent.world_model.renderer.parameters())
    fixed = dict(objective.image_features.named_parameters())
    assert fixed
    assert not any(p.requires_grad for p in fixed.values())


def test_a_network_finds_equal_images_equal_and_blurred_ones_not(tmp_path: Path) -> None:
    stage = dataclasses.replace(RECIPE.pretrain, perceptual="tower")
    features = build_objective(RECIPE, stage, build_agent(RECIPE)).image_features
    image = torch.rand(1, 3, 12, 20, generator=torch.Generator().manual_seed(0))
    blurred = torch.nn.functional.avg_pool2d(image, 3, 1, 1)
    levels = features(image)
    assert [level.shape[-2:] for level in levels] == [(12, 20), (6, 10), (3, 5)]
    assert all(torch.equal(a, b) for a, b in zip(levels, features(image), strict=True))
    assert all((a - b).abs().mean() > 0.01 for a, b in zip(levels, features(blurred), strict=True))


@pytest.mark.parametrize(
    ("over_frames", "future", "l1", "occ"),
    [
        ("mean", 1.0, 0.9 / 3, 1.3133 + 0.3133 + 1.3133),
        ("mean", 0.25, (0.5 + 0.4 / 4) / 1.5, 2 * (1.3133 + 1.6266 / 4)),
        ("sum", 1.0, 0.9, 3 * (1.3133 + 0.3133 + 1.3133)),
        ("sum", 0.25, 0.5 + 0.4 / 4, 3 * (1.3133 + 1.6266 / 4)),
    ],
)
def test_frames_are_summed_or_averaged_as_the_weights_say(
    over_frames: str, future: float, l1: float, occ: float, example: Example
) -> None:
    """A model that renders grey everywhere and predicts the logit 1 in every voxel.

    The true images have 0, 0.2 and 0.4 at now and later, so L1 is 0.5, 0.3 and 0.1. All voxels are free, then
    occupied, then free: the cross entropies are ln(1 + e), ln(1 + 1/e) and ln(1 + e), here times 3.
    """
    now = example.clip.now
    images, occupied = example.clip.images.clone(), example.occupancy.values.clone()
    for k in range(3):
        images[:, now + k] = (0, 51, 102)[k]
        occupied[:, now + k] = (0.0, 1.0, 0.0)[k]
    example = dataclasses.replace(
        example,
        clip=dataclasses.replace(example.clip, images=images),
        occupancy=dataclasses.replace(example.occupancy, values=occupied),
    )
    weights = dataclasses.replace(
        RECIPE.pretrain.weights, recon=2.0, occ=5.0, scal=0.0, bce=3.0, over_frames=over_frames, future=future
    )
    agent = build_agent(RECIPE)
    for last, bias in ((agent.world_model.occupancy[-1], 1.0), (agent.world_model.renderer.recon[-1], 0.0)):
        torch.nn.init.zeros_(last.weight)
        torch.nn.init.constant_(last.bias, bias)
    stage = dataclasses.replace(RECIPE.pretrain, weights=weights)
    losses = build_objective(RECIPE, stage, agent)(example, torch.Generator().manual_seed(0))
    found = {name: value.item() for name, value in losses.items()}
    assert found["l1"] == pytest.approx(l1)
    assert found["occ"] == pytest.approx(occ, rel=1e-4)
    assert found["loss"] == pytest.approx(2 * l1 + 5 * occ, rel=1e-4)


def test_recipes_of_towns_take_the_mean_and_base_recipes_the_sum() -> None:
    for name in ("nemo_town", "nemo_base", "driveworld_town", "driveworld_base"):
        for stage in (find_recipe(name).pretrain, find_recipe(name).finetune):
            assert stage.weights.over_frames == ("sum" if name.endswith("base") else "mean")


@pytest.mark.parametrize("stage", ["pretrain", "finetune"])
def test_a_file_of_vgg_weights_fits_the_recipes_of_towns(stage: str, tmp_path: Path) -> None:
    """Both stages render 6 × 10 pixels: too few to be pooled three times."""
    file = vgg_file(tmp_path / "vgg.safetensors")
    recipe = find_recipe("nemo_town", (f"{stage}.perceptual={file}",))
    chosen = getattr(recipe, stage)
    height, width = recipe.clips.image_hw
    features = VggFeatures(chosen.perceptual)
    taps = features(torch.rand(1, 3, height // chosen.ray_stride, width // chosen.ray_stride))
    assert [tap.shape[1] for tap in taps] == [64, 128, 256]


def test_a_file_that_is_named_and_wrong_is_one_line(tmp_path: Path) -> None:
    agent = build_agent(RECIPE)
    (tmp_path / "vgg.pth").write_bytes(b"no weights")
    for file, said in ((tmp_path / "none.pth", "no such file"), (tmp_path / "vgg.pth", "not VGG-16 weights")):
        with pytest.raises(InputError, match=said) as caught:
            build_objective(RECIPE, dataclasses.replace(RECIPE.pretrain, perceptual=str(file)), agent)
        assert "\n" not in str(caught.value)


def objective_of(stage: NemoStage, motion_std: float = 0.05) -> NemoObjective:
    """The same weights for every stage; batch normalisation at rest, so that items do not mix."""
    torch.manual_seed(0)
    objective = build_objective(RECIPE, stage, build_agent(RECIPE)).eval()
    for parameter in objective.agent.world_model.motion.parameters():
        torch.nn.init.normal_(parameter, std=motion_std)
    return objective


def losses_of(objective: NemoObjective, example: Example) -> dict[str, torch.Tensor]:
    return objective(example, torch.Generator().manual_seed(0))


def test_some_items_of_a_batch_are_imagined_and_all_train_the_present(example: Example) -> None:
    stage = dataclasses.replace(
        RECIPE.pretrain, weights=dataclasses.replace(RECIPE.pretrain.weights, recon=0.0, future=0.5)
    )
    some = objective_of(dataclasses.replace(stage, imagined=ImaginationSampling(items=1)))
    found = losses_of(some, example)["occ"]
    both = objective_of(dataclasses.replace(stage, imagine=False))
    first = objective_of(stage)
    present = losses_of(both, example)["occ"]
    of_first = dataclasses.replace(example[:1], key=example.key[:1])
    present_of_first = losses_of(both, of_first)["occ"]
    # The present counts 1, each of two imagined frames 0.5.
    futures = 2 * losses_of(first, of_first)["occ"] - present_of_first
    torch.testing.assert_close(found, 0.5 * present + 0.5 * futures)


def test_every_third_step_imagines_and_the_others_train_the_present(example: Example) -> None:
    stage = RECIPE.pretrain
    third = objective_of(dataclasses.replace(stage, imagined=ImaginationSampling(every=3))).train()
    always, never = (
        objective_of(stage).train(),
        objective_of(dataclasses.replace(stage, imagine=False)).train(),
    )
    for step in range(5):
        found = losses_of(third, example)
        torch.testing.assert_close(found, losses_of(always if step % 3 == 0 else never, example))
        third.zero_grad()
        found["loss"].backward()
        motion = [parameter.grad for parameter in third.agent.world_model.motion.parameters()]
        assert all(grad is not None for grad in motion)
        assert any(grad.any() for grad in motion) == (step % 3 == 0)


def test_an_interrupted_training_goes_on_with_the_step_that_is_due(example: Example) -> None:
    stage = dataclasses.replace(RECIPE.pretrain, imagined=ImaginationSampling(every=2))
    first, second = objective_of(stage).train(), objective_of(stage).train()
    losses_of(first, example)
    second.load_state_dict(first.state_dict())
    torch.testing.assert_close(losses_of(second, example), losses_of(first, example))


def test_past_frames_without_gradients_change_no_loss(example: Example) -> None:
    stage = RECIPE.pretrain
    # The motion is large enough that the loss depends on the past.
    whole, without = (
        objective_of(
            dataclasses.replace(stage, imagined=ImaginationSampling(past_gradient=on)), motion_std=0.3
        )
        for on in (True, False)
    )
    losses = losses_of(whole, example), losses_of(without, example)
    torch.testing.assert_close(losses[0], losses[1])
    for each in losses:
        each["loss"].backward()
    lifted = [next(o.agent.world_model.backbone.parameters()).grad for o in (whole, without)]
    assert not torch.allclose(*lifted)
    past = dataclasses.replace(example.clip, images=example.clip.images.clone())
    past.images[:, 0] = 0
    changed = losses_of(without, dataclasses.replace(example, clip=past))["loss"]
    assert not torch.isclose(changed, losses[1]["loss"], rtol=1e-4)  # the past is read


def test_a_planner_that_reads_imagined_frames_needs_them_of_every_item() -> None:
    stage = dataclasses.replace(RECIPE.finetune, imagined=ImaginationSampling(items=1))
    with pytest.raises(InputError, match="imagined frames of every item"):
        build_objective(RECIPE, stage, build_agent(RECIPE))
    with pytest.raises(InputError, match="imagined frames in every step"):
        build_objective(
            RECIPE,
            dataclasses.replace(RECIPE.finetune, imagined=ImaginationSampling(every=2)),
            build_agent(RECIPE),
        )
    for count in (0, -1):
        for imagined in (ImaginationSampling(items=count), ImaginationSampling(every=count)):
            none = dataclasses.replace(RECIPE.pretrain, imagined=imagined)
            with pytest.raises(InputError, match="set imagine to false"):
                build_objective(RECIPE, none, build_agent(RECIPE))


def test_examples_are_augmented_before_anything_is_read(example: Example) -> None:
    stage = dataclasses.replace(RECIPE.pretrain, augment=AugmentConfig(mirror=1.0))
    found = losses_of(objective_of(stage), example)
    across = mirrored(example, torch.ones(2, dtype=torch.bool))
    plain = objective_of(RECIPE.pretrain)
    generator = torch.Generator().manual_seed(0)
    torch.rand(2, generator=generator)  # which items are mirrored
    torch.testing.assert_close(found, plain(across, generator))


def test_the_ego_motion_learns_from_the_driven_path_of_imagined_items(example: Example) -> None:
    """The weight is that of the displacement alone; other losses stay, and the rigid head gets a gradient."""
    drive = torch.eye(4, dtype=torch.float64).repeat(*example.clip.T_world_ego.shape[:2], 1, 1)
    drive[:, :, 0, 3] = 2.0 * torch.arange(drive.shape[1])
    example = dataclasses.replace(example, clip=dataclasses.replace(example.clip, T_world_ego=drive))
    torch.manual_seed(0)
    agent = build_agent(RECIPE)
    losses = {}
    for weight in (0.0, 0.5):
        weights = dataclasses.replace(RECIPE.pretrain.weights, ego=weight)
        stage = dataclasses.replace(
            RECIPE.pretrain, weights=weights, imagined=ImaginationSampling(items=1), augment=AugmentConfig()
        )
        objective = build_objective(RECIPE, stage, agent).eval()
        losses[weight] = objective(example, torch.Generator().manual_seed(1))
    assert "ego" not in losses[0.0]
    steps = RECIPE.clips.future_frames
    expected_m = sum(2.0 * k for k in range(1, steps + 1)) / steps
    torch.testing.assert_close(losses[0.5]["ego"], torch.tensor(expected_m))
    torch.testing.assert_close(losses[0.5]["loss"], losses[0.0]["loss"] + 0.5 * losses[0.5]["ego"])
    losses[0.5]["ego"].backward()
    rigid = agent.world_model.motion.rigid[-1]
    assert rigid.bias.grad is not None
    assert rigid.bias.grad.abs().max() > 0


def test_the_flow_learns_from_labels_of_imagined_items(example: Example) -> None:
    """The loss is the error of the velocity, times the emphasis; the flow points to where content was."""
    velocity = torch.tensor([2.0, -1.0, 0.5])
    frames, now = example.flow.values.shape[1], example.clip.now
    # Frames differ, and so do the items, of which the first alone is imagined
    scale = torch.stack([1.0 + torch.arange(frames), 20.0 + torch.arange(frames)])
    values = (scale.view(2, frames, 1, 1, 1, 1) * velocity.view(3, 1, 1, 1)).expand_as(example.flow.values)
    example = dataclasses.replace(example, flow=dataclasses.replace(example.flow, values=values))
    torch.manual_seed(0)
    agent = build_agent(RECIPE)
    losses = {}
    for weight in (0.0, 0.5):
        weights = dataclasses.replace(RECIPE.pretrain.weights, flow=weight, moving=4.0)
        stage = dataclasses.replace(
            RECIPE.pretrain, weights=weights, imagined=ImaginationSampling(items=1), augment=AugmentConfig()
        )
        objective = build_objective(RECIPE, stage, agent).eval()
        losses[weight] = objective(example, torch.Generator().manual_seed(1))
    assert "flow" not in losses[0.0]
    imagined = scale[0, now + 1 : now + 1 + RECIPE.clips.future_frames]
    torch.testing.assert_close(losses[0.5]["flow"], 4.0 * velocity.norm() * imagined.mean())
    torch.testing.assert_close(losses[0.5]["loss"], losses[0.0]["loss"] + 0.5 * losses[0.5]["flow"])
    losses[0.5]["flow"].backward()
    bias = agent.world_model.motion.flow[-1].bias
    assert bias.grad is not None
    # A descent step makes the flow the opposite of the velocity
    assert (bias.grad.view(-1, 3) * velocity > 0).all()
