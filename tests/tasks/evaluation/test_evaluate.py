"""An evaluation from end to end, on small made-up drives."""

import dataclasses
import math
from collections.abc import Callable, Iterator

import pytest
import torch
from torch.utils.data import DataLoader, Dataset

from foredrive.errors import InputError
from foredrive.methods.planner.baselines import ConstantVelocity, StandStill
from foredrive.scene import Clip, Example, Trajectory, VoxelGrid
from foredrive.tasks.evaluation.run import evaluate
from foredrive.tasks.occupancy.scores import OccupancyPrior
from foredrive.tasks.planning.protocols import PROTOCOLS
from foredrive.tasks.predictor import Prediction

MakeExample = Callable[..., Example]
FRAMES = 3
ABOUT = dict.fromkeys(["frame_dt_s"], 0.5)


class Oracle:
    """Knows the answers by the speed in the observed clip; can be told to be wrong, or to break."""

    def __init__(self, *examples: Example) -> None:
        self.answers = {self._fingerprint(example.clip): example for example in examples}
        self.seen: list[Clip] = []
        self.breaks_on: set[float] = set()
        self.nan_on: set[float] = set()
        self.flip = 0.0

    @staticmethod
    def _fingerprint(clip: Clip) -> tuple[float, ...]:
        return tuple(clip.ego_speed_mps[:, clip.now].tolist())

    def predict(self, observed: Clip, asked: object) -> Prediction:
        self.seen.append(observed)
        speeds = self._fingerprint(observed)
        if self.breaks_on & set(speeds):
            raise RuntimeError("out of luck\nand more lines")
        rows = [next(e for key, e in self.answers.items() if key == (speed,)) for speed in speeds]
        now = rows[0].clip.now
        frames = slice(now, now + FRAMES)
        occupied = torch.cat([e.occupancy.values[:, frames, 0] for e in rows]) > 0.5
        logit = torch.where(occupied, 4.0, -4.0)
        for i, speed in enumerate(speeds):
            if speed in self.nan_on:
                logit[i, 0, 0, 0, 0] = math.nan
        plan = Trajectory(
            xy=torch.cat([e.clip.future.xy for e in rows]),
            yaw=torch.cat([e.clip.future.yaw for e in rows]),
            valid=torch.cat([e.clip.future.valid for e in rows]),
            log_prob=torch.zeros(len(rows), 1),
            dt_s=0.5,
        )
        images = torch.cat([e.clip.images[:, frames, :, :, 1::2, 1::2] for e in rows]).float() / 255
        return Prediction(
            occupancy_logit=logit,
            plan=plan,
            flow_mps=torch.cat([e.flow.values[:, frames] for e in rows]),
            images=(images + 0.1).clamp(0, 1),
            image_stride=2,
        )


def test_who_knows_the_answers_gets_full_marks(make_example: MakeExample) -> None:
    ones = [make_example(i) for i in range(3)]
    oracle = Oracle(*ones)
    result = evaluate(oracle, [make_example(0, 1), make_example(2)], **ABOUT)
    summary = result.summary
    assert result.failures == ()
    assert (summary["items"], summary["failed"]) == (3, 0)
    for scope in ("", "above_ground."):
        for when in ("now", "future_500ms", "future_1s"):
            for kind in ("iou", "precision", "recall"):
                assert summary[f"occupancy.{scope}{kind}_{when}"] == 1.0
    for protocol in PROTOCOLS:
        assert summary[f"planning.{protocol}.l2_avg_m"] == 0.0
        assert summary[f"planning.{protocol}.collision_avg_pct"] == 0.0
        assert summary[f"planning.{protocol}.frames_counted"] == 3
        assert summary[f"planning.{protocol}.frames_invalid"] == 0
        assert summary[f"planning.{protocol}.frames_without_boxes"] == 0
    assert summary["flow.epe_moving_now_mps"] == 0.0
    assert 1.0 < summary["flow.epe_moving_now_mps.no_motion"] < 10.0
    assert 20.0 <= summary["image.psnr_db"] < 22.0  # 0.1 off, less where clamped
    assert 0.5 < summary["image.future_1s.ssim"] < 1.0
    assert summary["peak_rss_gib"] > 0.1
    assert summary["wall_s"] > 0
    assert summary["command_source"] == "none"


def test_the_model_never_sees_the_future(make_example: MakeExample) -> None:
    oracle = Oracle(make_example(0))
    evaluate(oracle, [make_example(0)], **ABOUT)
    (observed,) = oracle.seen
    assert observed.now == observed.t_s.shape[1] - 1
    assert not observed.future.valid.any()
    assert not observed.future.xy.any()


def test_figures_do_not_depend_on_the_batches(make_example: MakeExample) -> None:
    class Wrong(Oracle):
        def predict(self, observed: Clip, asked: object) -> Prediction:
            answer = super().predict(observed, asked)
            assert answer.occupancy_logit is not None
            assert answer.plan is not None
            plan = dataclasses.replace(answer.plan, xy=answer.plan.xy + 1.5)
            return dataclasses.replace(
                answer, occupancy_logit=answer.occupancy_logit.roll(1, dims=-1), plan=plan
            )

    ones = [make_example(i) for i in range(4)]
    apart = evaluate(Wrong(*ones), ones, **ABOUT).summary
    together = evaluate(Wrong(*ones), [make_example(0, 1, 2, 3)], **ABOUT).summary
    assert 0 < apart["occupancy.iou_now"] < 0.5
    for key in together:
        if key not in ("wall_s", "peak_rss_gib", "command_source"):
            assert together[key] == pytest.approx(apart[key], rel=1e-5, nan_ok=True), key


def test_failures_are_counted_and_never_scored(make_example: MakeExample) -> None:
    ones = [make_example(i) for i in range(5)]
    oracle = Oracle(*ones)
    speed = [float(e.clip.ego_speed_mps[0, 0]) for e in ones]
    oracle.breaks_on, oracle.nan_on = {speed[1]}, {speed[4]}
    result = evaluate(oracle, [make_example(0, 1, 2), make_example(3, 4)], **ABOUT)
    assert (result.summary["items"], result.summary["failed"]) == (5, 2)
    assert [failure.key for failure in result.failures] == ["drive@1", "drive@4"]
    assert result.failures[0].reason == "RuntimeError: out of luck"
    assert "not finite" in result.failures[1].reason
    assert result.summary["planning.uniad.frames_counted"] == 3
    assert result.summary["occupancy.iou_now"] == 1.0


def test_a_batch_that_cannot_be_loaded_is_counted_and_the_rest_goes_on(make_example: MakeExample) -> None:
    class Drives(Dataset[Example]):
        def __len__(self) -> int:
            return 3

        def __getitem__(self, index: int) -> Example:
            if index == 1:
                raise InputError("drive 1: corrupt JPEG")
            return make_example(index)

    loader = DataLoader(Drives(), batch_size=1, collate_fn=lambda items: items[0])
    result = evaluate(Oracle(make_example(0), make_example(2)), loader, **ABOUT)
    assert (result.summary["items"], result.summary["failed"]) == (3, 1)
    assert result.failures[0].reason == "drive 1: corrupt JPEG"


def test_every_item_of_a_batch_that_cannot_be_loaded_failed(make_example: MakeExample) -> None:
    def collate(indices: list[int]) -> Example:
        if 1 in indices:
            raise InputError("drive 1: corrupt JPEG")
        return make_example(*indices)

    told: list[int] = []
    loader = DataLoader(range(4), batch_size=2, collate_fn=collate)  # type: ignore[arg-type]
    oracle = Oracle(make_example(2), make_example(3))
    summary = evaluate(oracle, loader, on_items=told.append, **ABOUT).summary
    assert (summary["items"], summary["failed"]) == (4, 2)
    assert told == [2, 2]


def test_a_plan_that_lacks_a_step_failed(make_example: MakeExample) -> None:
    class Short(Oracle):
        def predict(self, observed: Clip, asked: object) -> Prediction:
            answer = super().predict(observed, asked)
            assert answer.plan is not None
            answer.plan.valid[1, 0, 3] = False
            return answer

    ones = [make_example(i) for i in range(3)]
    result = evaluate(Short(*ones), [make_example(0, 1, 2)], **ABOUT)
    assert [failure.key for failure in result.failures] == ["drive@1"]
    assert result.summary["planning.uniad.frames_counted"] == 2


def test_when_nothing_succeeds_there_is_no_result(make_example: MakeExample) -> None:
    oracle = Oracle()
    oracle.breaks_on = {float(make_example(0).clip.ego_speed_mps[0, 0])}
    with pytest.raises(InputError, match="all 1 items failed, RuntimeError: out of luck"):
        evaluate(oracle, [make_example(0)], **ABOUT)
    with pytest.raises(InputError, match="no items"):
        evaluate(oracle, [], **ABOUT)


def test_ctrl_c_is_no_failure(make_example: MakeExample) -> None:
    class Interrupted:
        def predict(self, observed: Clip, asked: object) -> Prediction:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        evaluate(Interrupted(), [make_example(0)], **ABOUT)


def test_baselines_stand_in_the_same_summary(make_example: MakeExample) -> None:
    ones = [make_example(i) for i in range(3)]
    for example in ones:
        example.clip.ego_speed_valid[:] = False  # so that constant velocity looks at poses
    baselines = {"stand_still": StandStill(6, 0.5), "constant_velocity": ConstantVelocity(6, 0.5)}
    summary = evaluate(Oracle(*ones), ones, baselines=baselines, **ABOUT).summary
    far = torch.cat([e.clip.future.xy[0, 0, [1, 3, 5]].norm(dim=-1) for e in ones])
    assert summary["planning.stand_still.uniad.l2_avg_m"] == pytest.approx(float(far.mean()), rel=1e-5)
    assert (
        summary["planning.constant_velocity.uniad.l2_avg_m"] < summary["planning.stand_still.uniad.l2_avg_m"]
    )
    assert summary["planning.constant_velocity.failed"] == 0
    assert "planning.constant_velocity.vad.collision_3s_pct" in summary


def test_a_baseline_that_fails_does_not_fail_the_model(make_example: MakeExample) -> None:
    blind = make_example(0, 1)
    blind = dataclasses.replace(blind, clip=blind.clip.frames(slice(2, None)))
    blind.clip.ego_speed_valid[:] = False
    oracle = Oracle(make_example(0), make_example(1))
    summary = evaluate(
        oracle, [blind], baselines={"constant_velocity": ConstantVelocity(6, 0.5)}, **ABOUT
    ).summary
    assert summary["failed"] == 0
    assert summary["planning.constant_velocity.failed"] == 2
    assert math.isnan(summary["planning.constant_velocity.uniad.l2_avg_m"])
    assert summary["planning.constant_velocity.uniad.frames_counted"] == 0


def test_the_occupancy_prior_stands_beside_every_occupancy_figure(make_example: MakeExample) -> None:
    training = make_example(*range(10, 14))
    prior = OccupancyPrior(FRAMES, training.occupancy.spec)
    now = training.clip.now
    prior.add(training.occupancy[:, now : now + FRAMES])
    ones = [make_example(0), make_example(1)]
    summary = evaluate(Oracle(*ones), ones, prior=prior, **ABOUT).summary
    scopes = ("occupancy.iou", "occupancy.precision", "occupancy.recall", "occupancy.above_ground.")
    figures = [k for k in summary if k.startswith(scopes) and "best_constant" not in k]
    for key in [k for k in figures if not k.endswith("copy")]:  # persistence is a baseline itself
        assert 0 <= summary[f"{key}.best_constant"] < 1, key
    assert 0 < summary["occupancy.above_ground.iou_now.best_constant_threshold"] <= 1
    # The constant is what it says: the prior cut at that threshold, scored on the test set.
    predicted, _ = prior.best_grid()
    truth = torch.cat([e.occupancy.values[:, now, 0] > 0.5 for e in ones])
    known = torch.cat([e.occupancy.known[:, now] for e in ones])
    both = (predicted[0] & truth & known).sum()
    either = ((predicted[0] | truth) & known).sum()
    assert summary["occupancy.iou_now.best_constant"] == pytest.approx(float(both / either))


def test_mismatched_frames_are_named(make_example: MakeExample) -> None:
    example = make_example(0)
    prior = OccupancyPrior(2, example.occupancy.spec)
    with pytest.raises(InputError, match="prior is for 2 frames, the model predicts 3"):
        evaluate(Oracle(example), [example], prior=prior, **ABOUT)
    short = dataclasses.replace(
        example,
        clip=example.clip.frames(slice(0, 4)),
        occupancy=VoxelGrid(
            example.occupancy.spec, example.occupancy.values[:, :4], example.occupancy.known[:, :4]
        ),
    )
    with pytest.raises(InputError, match="3 frames from now on are predicted, but the clips hold only 2"):
        evaluate(Oracle(example), [short], **ABOUT)


def test_where_the_commands_came_from(make_example: MakeExample) -> None:
    def source(counts: dict[str, int]) -> object:
        summary = evaluate(Oracle(make_example(0)), [make_example(0)], command_source=counts, **ABOUT).summary
        assert summary["command_source.route"] == counts["route"]
        return summary["command_source"]

    assert source({"route": 4, "driven_future": 0, "none": 0}) == "route"
    assert source({"route": 4, "driven_future": 1, "none": 0}) == "mixed"
    assert source({"route": 0, "driven_future": 0, "none": 0}) == "none"


def test_progress_is_told(make_example: MakeExample) -> None:
    told: list[int] = []

    def batches() -> Iterator[Example]:
        yield make_example(0, 1)
        yield make_example(2)

    evaluate(Oracle(*[make_example(i) for i in range(3)]), batches(), on_items=told.append, **ABOUT)
    assert told == [2, 1]
