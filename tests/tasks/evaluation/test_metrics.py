"""Adding a metric: a class that keeps the protocol, and a place in the list that `evaluate` is given."""

import dataclasses
from collections.abc import Callable
from statistics import median
from typing import get_args

import pytest
import torch

from foredrive.methods.planner.baselines import ConstantVelocity, StandStill
from foredrive.scene import Clip, Example
from foredrive.tasks.evaluation.metrics import METRICS
from foredrive.tasks.evaluation.run import evaluate
from foredrive.tasks.metric import EvaluationContext, Figures, Shown
from foredrive.tasks.predictor import Part, Prediction
from foredrive.tasks.rendering.image_metric import ImageMetric

MakeExample = Callable[..., Example]


class HeadingError:
    """Mean |planned - driven heading| at the plan's last step."""

    name = "heading"
    title = "Heading"
    shown = (Shown("error, rad", "error_rad", "straight_on", digits=2),)
    needs: frozenset[Part] = frozenset({"plan"})

    def __init__(self, context: EvaluationContext) -> None:
        self.errors_rad: list[float] = []

    def update(self, prediction: Prediction, truth: Example) -> None:
        error = prediction.plan.yaw[:, 0, -1] - truth.clip.future.yaw[:, 0, -1]
        self.errors_rad += error.abs().tolist()

    def result(self) -> Figures:
        return {"error_rad": sum(self.errors_rad) / len(self.errors_rad)}


class WholeLogs:
    """Needs all clips of a log in order, and all clips at once: as tracking and average precision do."""

    name = "logs"
    needs: frozenset[Part] = frozenset({"plan"})

    def __init__(self, context: EvaluationContext) -> None:
        self.keys: list[str] = []
        self.speeds_mps: list[float] = []

    def update(self, prediction: Prediction, truth: Example) -> None:
        self.keys += truth.key
        self.speeds_mps += truth.clip.ego_speed_mps[:, truth.clip.now].tolist()

    def result(self) -> Figures:
        return {"order": " ".join(self.keys), "median_mps": median(self.speeds_mps)}


class Images:
    """Needs what the predictor of this file cannot predict."""

    name = "views"
    needs: frozenset[Part] = frozenset({"images", "plan"})

    def __init__(self, context: EvaluationContext) -> None:
        pass

    def update(self, prediction: Prediction, truth: Example) -> None:
        raise AssertionError("there are no images")

    def result(self) -> Figures:
        return {"count": 0}


class GoOn:
    """Plans alone, and breaks on one speed."""

    def __init__(self) -> None:
        self.asked: set[frozenset[Part]] = set()
        self.breaks_on: float | None = None

    def predict(self, observed: Clip, asked: frozenset[Part]) -> Prediction:
        self.asked.add(asked)
        if self.breaks_on in observed.ego_speed_mps[:, observed.now].tolist():
            raise RuntimeError("out of luck")
        return Prediction(plan=ConstantVelocity(6, 0.5).act(observed))


def test_a_new_metric_judges_the_model_and_its_baselines(make_example: MakeExample) -> None:
    batches = [make_example(0, 1), make_example(2)]
    summary = evaluate(
        GoOn(),
        batches,
        frame_dt_s=0.5,
        metrics=(*METRICS, HeadingError),
        baselines={"stand_still": StandStill(6, 0.5)},
    ).summary
    driven = torch.cat([example.clip.future.yaw[:, 0, -1] for example in batches])
    assert summary["heading.error_rad"] == pytest.approx(float(driven.abs().mean()))
    assert summary["heading.stand_still.error_rad"] == pytest.approx(float(driven.abs().mean()))
    assert summary["planning.uniad.frames_counted"] == 3


def test_clips_come_in_order_and_all_of_them_before_the_result(make_example: MakeExample) -> None:
    predictor = GoOn()
    speeds = [float(make_example(i).clip.ego_speed_mps[0, 0]) for i in range(5)]
    predictor.breaks_on = speeds[1]
    batches = [make_example(0, 1, 2), make_example(3, 4)]
    result = evaluate(predictor, batches, frame_dt_s=0.5, metrics=(WholeLogs,))
    assert [failure.key for failure in result.failures] == ["drive@1"]
    assert result.summary["logs.order"] == "drive@0 drive@2 drive@3 drive@4"
    assert result.summary["logs.median_mps"] == pytest.approx(median(speeds[:1] + speeds[2:]))


def test_a_predictor_is_asked_for_what_the_metrics_need(make_example: MakeExample) -> None:
    predictor = GoOn()
    evaluate(predictor, [make_example(0)], frame_dt_s=0.5, metrics=(HeadingError,))
    assert predictor.asked == {frozenset({"plan"})}
    predictor.asked.clear()
    summary = evaluate(predictor, [make_example(0)], frame_dt_s=0.5, metrics=(HeadingError, Images)).summary
    assert predictor.asked == {frozenset({"plan", "images"})}
    assert "heading.error_rad" in summary
    assert "views.count" not in summary


def test_an_image_that_is_missing_is_not_averaged_over(make_example: MakeExample) -> None:
    truth = make_example(0)
    now = slice(truth.clip.now, truth.clip.now + 1)
    rendered = truth.clip.images[:, now, :, :, 1::2, 1::2] / 255 + 0.1
    rendered[:, :, 1] = 0.0
    truth.clip.image_valid[:, now, 1] = False
    metric = ImageMetric(EvaluationContext(0.5))
    metric.update(Prediction(images=rendered, image_stride=2), truth)
    assert metric.result()["psnr_db"] == pytest.approx(20.0, abs=1e-3)


def test_metrics_know_all_parts_of_a_prediction() -> None:
    fields = {field.name for field in dataclasses.fields(Prediction)} - {"image_stride"}
    assert set(get_args(Part)) == fields
    started = [start(EvaluationContext(0.5)) for start in METRICS]
    assert set().union(*(metric.needs for metric in started)) == fields
