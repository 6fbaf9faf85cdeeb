"""The head of affordances: it finds a lamp of one cell in any camera, and learns from what logs tell."""

import dataclasses

import pytest
import torch
from joint_heads import small_heads
from small_drives import one_example

from foredrive.errors import InputError
from foredrive.evaluation.metric import EvaluationContext
from foredrive.evaluation.metrics.affordances import AffordanceMetric
from foredrive.evaluation.predictor import Prediction
from foredrive.models.tasks.affordances import AffordanceHead, AffordanceHeadConfig, AffordanceSet
from foredrive.models.tasks.heads import TaskHeads, TaskVolume
from foredrive.models.tasks.plane import Plane, PlanePyramid
from foredrive.models.tasks.scene_tokens import SceneTokens
from foredrive.scene import CameraRig, VoxelSpec
from foredrive.scene.affordances import CELLS, TIMES, AffordanceEstimate, Affordances
from foredrive.scene.image_features import ImageFeatures
from foredrive.scene.task_truth import TaskTruth
from foredrive.scene.traffic_light import LightState
from foredrive.training.affordance_losses import AffordanceLossWeights, affordance_losses
from foredrive.training.mirrored_truth import mirrored_truth

SPEC = VoxelSpec(lower_m=(-4.0, -8.0, -1.0), voxel_m=1.0, shape_zyx=(2, 16, 24))
FEATURES = 4


def truth(light: list[int], known: bool = True) -> Affordances:
    b = len(light)
    yes = torch.full((b,), known)
    return Affordances(
        path_xy=torch.stack([torch.arange(10.0), torch.zeros(10)], -1).expand(b, 10, 2),
        path_valid=torch.ones(b, 10, dtype=torch.bool),
        light=torch.tensor(light),
        light_m=torch.full((b,), 25.0),
        light_known=yes,
        light_later=torch.tensor(light)[:, None].expand(b, 6),
        lamp_xyz=torch.tensor([[[20.0, 1.0, 3.0]]]).expand(b, 1, 3),
        lamp=torch.tensor([[state > 0] for state in light]),
        lamps_known=yes,
        lead=torch.tensor([k % 2 == 0 for k in range(b)]),
        lead_m=torch.full((b,), 12.0),
        lead_mps=torch.full((b,), 4.0),
        lead_known=yes,
        crossing_xy=torch.tensor([[[6.2, 1.3], [0.0, 0.0]]]).expand(b, 2, 2),
        crossing=torch.tensor([True, False]).expand(b, 2),
        crossing_known=yes,
        occupied=torch.zeros(b, TIMES, CELLS, dtype=torch.bool),
        occupied_known=torch.ones(b, TIMES, CELLS, dtype=torch.bool),
    )


def head() -> AffordanceHead:
    torch.manual_seed(0)
    planes = PlanePyramid(SPEC, channels=3, width=16, max_cells=8, past=False)
    return AffordanceHead(planes, FEATURES, AffordanceHeadConfig(hidden=16, people=3))


def images(lamp: list[int], seed: int) -> ImageFeatures:
    """Noise, and in one cell of one camera a lamp of the given state; none for 0."""
    rng = torch.Generator().manual_seed(seed)
    b, c, h, w = len(lamp), 2, 6, 8
    values = 0.1 * torch.randn(b, c, h, w, FEATURES, generator=rng)
    for item, state in enumerate(lamp):
        if state:
            camera, row, column = (int(torch.randint(n, (1,), generator=rng)) for n in (c, h, w))
            values[item, camera, row, column, state] += 2.0
    left, up = torch.meshgrid(torch.linspace(0.3, -0.3, w), torch.linspace(0.2, -0.2, h), indexing="xy")
    ahead = torch.nn.functional.normalize(torch.stack([torch.ones(h, w), left, up], dim=-1), dim=-1)
    direction = ahead.expand(b, c, h, w, 3)
    return ImageFeatures(values, direction, torch.full((b, c), 0.02), torch.ones(b, c))


def plane(b: int, seed: int) -> Plane:
    """Noise, and the person of `truth` in its cell."""
    features = 0.3 * torch.randn(b, 8, 16, 24, generator=torch.Generator().manual_seed(seed))
    features[:, 0, 9, 10] += 4.0
    return Plane(features, (-4.0, -8.0), 1.0)


def test_a_lamp_of_one_cell_is_learned_and_a_missing_camera_is_not_read() -> None:
    model = head()
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-2)
    weights = AffordanceLossWeights()
    for step in range(150):
        states = [(step + k) % 4 for k in range(8)]
        found = model(images(states, step), plane(8, step))
        losses = affordance_losses(found, truth(states), weights)
        optimizer.zero_grad()
        torch.stack(list(losses.values())).sum().backward()
        optimizer.step()
    states = [0, 1, 2, 3] * 8
    seen = images(states, 10_000)
    found = model(seen, plane(32, 10_000))
    right = found.estimate().light.argmax(-1) == torch.tensor(states)
    assert right.float().mean() > 0.9
    assert float((found.light_m[1].detach() - 25.0).abs()) < 5.0
    dark = dataclasses.replace(seen, valid=torch.zeros_like(seen.valid))
    assert (model(dark, plane(32, 10_000)).light_logits.std(dim=0) < found.light_logits.std(dim=0)).all()
    other = dataclasses.replace(
        seen, values=torch.randn_like(seen.values), valid=torch.zeros_like(seen.valid)
    )
    torch.testing.assert_close(model(dark, plane(32, 1)).feature, model(other, plane(32, 1)).feature)
    best = found.estimate().crossing_xy[:, 0]
    assert ((best - torch.tensor([6.5, 1.5])).abs().amax(-1) < 0.6).float().mean() > 0.9


def test_what_a_log_does_not_tell_trains_nothing() -> None:
    model = head()
    found = model(images([1, 2], 0), plane(2, 0))
    losses = affordance_losses(found, truth([1, 2], known=False), AffordanceLossWeights())
    torch.stack(list(losses.values())).sum().backward()
    assert all(float(value.detach()) == 0 for value in losses.values())
    assert all(p.grad is None or not p.grad.any() for p in model.parameters())


def test_a_lead_vehicle_of_unknown_speed_trains_and_judges_all_but_its_speed() -> None:
    """Frames 0 and 2 have a lead vehicle at 12 m; the log tells the speed of the second one alone."""
    whole = truth([1, 3, 0])
    unknown = dataclasses.replace(whole, lead_mps=torch.tensor([torch.nan, 4.0, 4.0]))
    found = head()(images([1, 3, 0], 0), plane(3, 0))
    losses = affordance_losses(found, unknown, AffordanceLossWeights())
    error_mps = (found.lead_mps[2] - 4.0).abs()
    torch.testing.assert_close(losses["lead_mps"], AffordanceLossWeights().lead_mps * error_mps)
    usual = affordance_losses(found, whole, AffordanceLossWeights())
    torch.testing.assert_close(losses["lead_m"], usual["lead_m"])
    losses["lead_mps"].backward()
    metric = AffordanceMetric(EvaluationContext(0.5))
    example = dataclasses.replace(one_example(0), truth=TaskTruth(affordances=unknown))
    seen = dataclasses.replace(estimate([1, 3, 0], [[6.0, 1.0]], 0.5), lead_mps=torch.full((3,), 5.5))
    metric.update(Prediction(affordances=seen), example)
    assert metric.result()["lead_error_mps"] == pytest.approx(1.5)
    assert metric.result()["leads_counted"] == 2


def test_people_are_judged_from_the_front_bumper_of_the_recording_vehicle() -> None:
    """A bumper at 4.09 m: someone at 24 m is 19.9 m away."""
    metric = AffordanceMetric(EvaluationContext(0.5))
    far = dataclasses.replace(truth([0]), crossing_xy=torch.tensor([[[24.0, 0.0], [0.0, 0.0]]]))
    example = dataclasses.replace(one_example(0), truth=TaskTruth(affordances=far))
    metric.update(Prediction(affordances=estimate([0], [[24.0, 0.0]], 0.5)), example)
    assert metric.result()["crossing_counted"] == 1


def test_heads_and_tokens_of_a_planner_read_affordances() -> None:
    config = small_heads(("affordances",)).heads
    torch.manual_seed(0)
    heads = TaskHeads(config, SPEC, channels=FEATURES)
    volume = TaskVolume(torch.randn(2, FEATURES, *SPEC.shape_zyx), images=images([1, 3], 0))
    tokens = SceneTokens(("affordances",), config, SPEC, width=12)(heads({"occupancy": volume}))
    assert tokens.shape == (2, 1 + config.affordances.people, 12)
    with pytest.raises(InputError, match="this belief has none"):
        heads({"occupancy": dataclasses.replace(volume, images=None)})
    with pytest.raises(InputError, match=r"attends names affordances.*train with affordances"):
        SceneTokens(("affordances",), small_heads(("detection",)).heads, SPEC, width=12)


def test_mirrored_truth_crosses_from_the_other_side() -> None:
    chosen = torch.tensor([False, True])
    both = mirrored_truth(TaskTruth(affordances=truth([1, 1])), chosen).affordances
    assert both.crossing_xy[:, 0].tolist() == [pytest.approx([6.2, 1.3]), pytest.approx([6.2, -1.3])]
    assert both.light.tolist() == [1, 1]


def test_lamps_are_supervised_in_the_cell_that_they_project_to() -> None:
    """A camera 4 m up and 90° wide looks ahead: a lamp at (20, 1, 3) lies 1/20 left and below its middle."""
    pose = torch.tensor([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 4.0], [0, 0, 0, 1]])
    rig = CameraRig(
        K=torch.tensor([[4.0, 0, 4.0], [0, 4.0, 3.0], [0, 0, 1.0]]).expand(2, 1, 3, 3),
        T_ego_cam=pose.expand(2, 1, 4, 4),
        dist=torch.zeros(2, 1, 5),
        readout_s=torch.zeros(2, 1),
        names=("ahead",),
        size_hw=(6, 8),
    )
    lamps = torch.full((2, 1, 6, 8, 3), -6.0)
    lamps[0, 0, 3, 3, 0] = 6.0  # u = 3.8, v = 3.2
    one, logits = torch.zeros(2), torch.zeros(2, 16, 24)
    found = AffordanceSet(
        torch.zeros(2, 4), lamps, one, one, one, one, logits, one[:, None], (-4.0, -8.0), 1.0, 2
    )
    weights = AffordanceLossWeights()
    red_and_none = truth([1, 0])
    right = affordance_losses(found, red_and_none, weights, rig)["lamps"]
    other = affordance_losses(found, truth([3, 0]), weights, rig)["lamps"]
    assert right < 0.01 < 1.0 < other
    assert affordance_losses(found, red_and_none, weights)["lamps"] == 0


def estimate(light: list[int], crossing_xy: list[list[float]], p: float) -> AffordanceEstimate:
    b = len(light)
    return AffordanceEstimate(
        light=torch.eye(4)[light],
        light_m=torch.full((b,), 28.0),
        lead=torch.tensor([0.9, 0.2, 0.9][:b]),
        lead_m=torch.full((b,), 10.5),
        lead_mps=torch.full((b,), 4.0),
        crossing_xy=torch.tensor(crossing_xy)[None].expand(b, -1, 2),
        crossing=torch.full((b, len(crossing_xy)), p),
    )


def test_figures_by_hand() -> None:
    """Three frames: red seen as red, green seen as red, none seen as none; lead vehicles in 0 and 2."""
    metric = AffordanceMetric(EvaluationContext(0.5))
    example = dataclasses.replace(one_example(0), truth=TaskTruth(affordances=truth([1, 3, 0])))
    found = estimate([1, 1, 0], [[6.0, 1.0], [12.0, 3.0]], 0.5)
    metric.update(Prediction(affordances=found), example)
    figures = metric.result()
    assert figures["light_accuracy_40m"] == 0.5
    assert figures["light_accuracy_40m.commonest"] == 0.5
    assert figures["false_lights"] == 0.0
    assert figures["light_error_m"] == pytest.approx(3.0)
    assert (figures["lead_recall"], figures["lead_precision"]) == (1.0, 1.0)
    assert figures["lead_error_m"] == pytest.approx(1.5)
    assert (figures["crossing_recall_20m"], figures["crossing_precision_20m"]) == (1.0, 0.5)
    unsure = AffordanceMetric(EvaluationContext(0.5))
    unsure.update(Prediction(affordances=estimate([1, 1, 0], [[6.0, 1.0]], 0.1)), example)
    assert unsure.result()["crossing_recall_20m"] == 0.0
    assert LightState.RED == 1


def test_peaks_are_listed_once() -> None:
    logits = torch.full((1, 16, 24), -6.0)
    logits[0, 9, 10], logits[0, 9, 11], logits[0, 2, 3] = 3.0, 2.0, 1.0
    one, lamps = torch.zeros(1), torch.zeros(1, 1, 2, 2, 3)
    found = AffordanceSet(
        torch.zeros(1, 4), lamps, one, one, one, one, logits, one[:, None], (-4.0, -8.0), 1.0, 2
    )
    assert found.estimate().crossing_xy[0].tolist() == [[6.5, 1.5], [-0.5, -5.5]]
