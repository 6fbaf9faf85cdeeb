"""The detection task: what a sample of a log is, and a head on a world model's own volume."""

import dataclasses
import math
from collections.abc import Callable

import pytest
import torch
from miniature import miniature

from benchmarks.common.detection import (
    ARMS,
    CLASSES,
    DetectionSplit,
    compare_losses,
    detection_samples,
    evaluate,
    hits_volume,
    objects_of,
    observed_samples,
    uniform_background,
)
from foredrive.data import LogPath
from foredrive.errors import InputError
from foredrive.heads.detection_losses import matching_loss, set_loss
from foredrive.heads.detection_network import DetectionHead
from foredrive.heads.detection_training import fit_head, predict_sets
from foredrive.runs.build import build_agent
from foredrive.scene import Category, Example, LidarSweep, VoxelSpec
from foredrive.scene.boxes import unlabelled
from foredrive.sets import LabelledBoxes

SPEC = VoxelSpec(lower_m=(-8.0, -8.0, -1.0), voxel_m=1.0, shape_zyx=(4, 16, 16))


def sweep_to(points: list[tuple[float, float, float]]) -> LidarSweep:
    """Beams from the origin that end at these points; the last one is a miss."""
    ends = torch.tensor(points)
    range_m = ends.norm(dim=-1)
    returned = torch.ones(len(points), dtype=torch.bool)
    returned[-1] = False
    return LidarSweep(
        origin_ego=torch.zeros(len(points), 3),
        dir_ego=ends / range_m[:, None],
        range_m=range_m,
        returned=returned,
        intensity=torch.zeros(len(points)),
        dt_s=torch.zeros(len(points)),
        beam=torch.zeros(len(points), dtype=torch.long),
        valid=torch.ones(len(points), dtype=torch.bool),
    )


def test_hits_by_hand() -> None:
    """Two hits in one voxel, one beyond the volume, one beam that met nothing."""
    volume = hits_volume(
        sweep_to([(3.2, 0.5, 0.5), (3.7, 0.5, 0.5), (20.0, 0.0, 0.5), (1.0, 1.0, 1.0)]), SPEC
    )
    assert volume.sum().item() == pytest.approx(math.log(3))
    assert volume[0, 1, 8, 11].item() == pytest.approx(math.log(3))


def test_objects_that_are_seen_of_known_classes(make_example: Callable[..., Example]) -> None:
    """Of a car with three hits, a car with two, a barrier and a pedestrian beyond the volume, the first."""
    clip = make_example(spec=SPEC, batch=1, past=0, future=0).clip.map_tensors(lambda tensor: tensor[0])
    places = torch.tensor([[5.0, 0.0, 0.5], [-5.0, 0.0, 0.5], [0.0, 5.0, 0.5], [0.0, 20.0, 0.5]])
    kinds = torch.tensor([Category.CAR, Category.CAR, Category.BARRIER, Category.PEDESTRIAN])
    hits = [
        (x + 0.1 * n, y, 0.5)
        for (x, y, _), count in zip(places.tolist(), (3, 2, 3, 3), strict=True)
        for n in range(count)
    ]
    sweep = sweep_to([*hits, (1.0, 0.0, 1.0)])
    boxes = dataclasses.replace(
        clip.boxes,
        centre=places[None],
        size_lwh=torch.tensor([4.0, 2.0, 1.5]).expand(1, 4, 3),
        yaw=torch.full((1, 4), 0.1),
        velocity=torch.zeros(1, 4, 2),
        track_id=torch.arange(4)[None],
        category=kinds[None],
        valid=torch.ones(1, 4, dtype=torch.bool),
        **unlabelled(1, 4),
    )
    clip = dataclasses.replace(clip, sweeps=sweep.map_tensors(lambda tensor: tensor[None]), boxes=boxes)
    found = objects_of(clip, SPEC)
    assert found.label.tolist() == [CLASSES.index("vehicle")]
    torch.testing.assert_close(
        found.state[0], torch.tensor([5.0, 0.0, 0.5, *torch.tensor([4.0, 2.0, 1.5]).log()])
    )


def test_a_log_from_samples_to_figures(log: LogPath) -> None:
    spec = miniature().clips.voxels
    samples = detection_samples(log, spec, stride_s=1.0)
    assert len(samples) > 2
    assert all(sample.volume.sum() > 0 for sample in samples)
    torch.manual_seed(0)
    head = DetectionHead(spec, channels=1, classes=len(CLASSES), width=16, shrink=1, layers=1, heads=2)
    head = fit_head(head, [sample[:2] for sample in samples], matching_loss, steps=2, batch=2)
    figures = evaluate(predict_sets(head, [sample.volume for sample in samples]), samples, spec)
    assert math.isfinite(figures["pmb_nll"])
    assert figures["objects"] == sum(len(sample.objects.label) for sample in samples)
    with pytest.raises(InputError, match="fewer than a batch"):
        fit_head(head, [samples[0][:2]], matching_loss, steps=1, batch=2)


def test_what_a_world_model_sees_has_the_objects_that_lidar_meets(log: LogPath) -> None:
    recipe = miniature()
    model = build_agent(recipe).world_model.eval()
    seen = observed_samples(log, model, recipe.clips)
    hit = detection_samples(log, recipe.clips.voxels)
    assert seen[-1].volume.shape[1:] == hit[-1].volume.shape[1:]
    assert not seen[-1].volume.requires_grad
    assert len(seen[-1].volume) > 1
    first = len(hit) - len(seen)  # what it sees has a past
    for one, other in zip(seen, hit[first:], strict=True):
        assert one.objects.state.tolist() == other.objects.state.tolist()


def test_arms_of_a_comparison_go_on_from_one_head(log: LogPath) -> None:
    """A step of either loss makes a small difference; calibration brings existence nearer to the truth."""
    spec = miniature().clips.voxels
    samples = detection_samples(log, spec, stride_s=1.0)
    split = DetectionSplit((samples * 8)[:8], samples, samples)
    arms = compare_losses(lambda: split, spec, first_steps=2, more_steps=1)
    assert list(arms) == [name + end for end in ("", "_calibrated") for name in ARMS]
    found = {name: measure(3) for name, measure in arms.items()}
    assert found["mb_nll"]["pmb_nll"] == pytest.approx(found["matching"]["pmb_nll"], rel=0.2)
    assert found["mb_nll"]["pmb_nll"] != found["matching"]["pmb_nll"]
    assert found["matching_calibrated"]["existence_error"] < found["matching"]["existence_error"]
    assert {figures["frames"] for figures in found.values()} == {len(samples)}


def test_the_background_is_one_object_over_the_volume() -> None:
    process = uniform_background(SPEC)
    assert process.lower[:2].tolist() == [-8.0, -8.0]
    assert process.upper[:2].tolist() == [8.0, 8.0]
    assert process.expected_count.item() == pytest.approx(1.0)


def test_a_head_teaches_the_world_model_whose_volume_it_reads(make_example: Callable[..., Example]) -> None:
    recipe = miniature()
    spec = recipe.clips.voxels
    torch.manual_seed(0)
    model = build_agent(recipe).world_model
    clip = make_example(spec=spec, batch=2, past=1, future=0).clip
    volume = model.observe(clip.observed()).volume
    head = DetectionHead(spec, channels=volume.shape[1], classes=2, width=16, shrink=1, layers=1, heads=2)
    state = torch.tensor([[5.0, 0.0, 0.5, 1.4, 0.7, 0.4]])
    truth = LabelledBoxes(torch.zeros(1, dtype=torch.long), state, torch.zeros(1))
    found = head(volume)
    torch.stack([set_loss(found[n], truth) for n in range(2)]).mean().backward()
    taught = [p.grad for p in model.encoder.parameters() if p.grad is not None]
    assert max(float(grad.abs().max()) for grad in taught) > 0
