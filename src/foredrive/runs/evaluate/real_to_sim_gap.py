"""The real-to-sim gap: predictions of a trained run on real and on rendered images of the same times."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import torch
from torch import Tensor

from foredrive.data import collate
from foredrive.data.logs import Log
from foredrive.data.resizing import shrink_images
from foredrive.engine.provenance import collect_provenance
from foredrive.engine.summary import write_summary
from foredrive.errors import InputError
from foredrive.methods.reconstruction.reconstructed import ReconstructedScene
from foredrive.methods.reconstruction.views import CameraView
from foredrive.runs.evaluate.predict import AgentPredictor
from foredrive.runs.open_clips import open_clips
from foredrive.runs.reconstruction.reconstruct import read_reconstruction_data
from foredrive.runs.reconstruction.reconstruction_run import open_reconstruction, open_run_log
from foredrive.runs.train.run import Run, load_agent
from foredrive.scene import Clip, Example, VoxelGrid
from foredrive.tasks.evaluation.run import evaluate
from foredrive.tasks.metric import CEILING, Figures
from foredrive.tasks.occupancy.occupancy_metric import PERSISTENT
from foredrive.tasks.planning.protocols import STEP_S, STEPS
from foredrive.tasks.predictor import Part, Prediction, Predictor
from foredrive.tasks.rendering.image_scores import psnr_db

GAP = "gap.json"
REAL, RENDERED, AGREEMENT = "real", "rendered", "agreement"
ASKED: frozenset[Part] = frozenset({"occupancy_logit", "plan"})
_SAME_S = 1e-3
"""Tolerance of times that belong to one exposure, s."""


def measure_gap(
    run: Run, reconstructed: Path, out: Path, on_items: Callable[[int, int], None] = lambda done, of: None
) -> Figures:
    """Compare predictions on real and on rendered images at the held-out times of a reconstructed log.

    Write `out/gap.json` with three groups of metrics of `evaluate`: real images against the labels
    (`real.…`), rendered images against the labels (`rendered.…`), and rendered images against the predictions
    on real ones (`agreement.…`). Key frames before now are rendered too, although the scene may have been
    trained on them.

    Args:
        run: its recipe must ask for cameras that were reconstructed.
        reconstructed: folder of a reconstruction; its log must still exist.
        out: output folder.
        on_items: called with the number of finished times and of all times.

    Raises:
        InputError: a camera was not reconstructed, or no clip lies at a held-out time.
    """
    scene, (recipe, log) = open_reconstruction(reconstructed).scene, open_run_log(reconstructed)
    data = read_reconstruction_data(recipe, log, (reconstructed / "cache").absolute())
    views = [*data.train.cameras, *data.held_out.cameras]
    clips = run.recipe.clips
    frames = max(clips.future_frames, round(STEPS * STEP_S / clips.frame_dt_s))
    config = dataclasses.replace(
        clips.judged,
        image_hw=recipe.image_hw,
        future_frames=frames,
        future_images=False,
        now_stride_s=_SAME_S,
    )
    dataset = open_clips([log], config, reconstructed / "cache")
    opened = Log(log)
    cameras = [data.vehicle.camera(name) for name in dataset.camera_names]
    t_us, every = opened.t_us, recipe.hold_out_every
    held_us = set(t_us[every - 1 :: every].tolist()) if every else set()
    moments = [k for k in range(len(dataset)) if dataset.now_us(k) in held_us]
    if not moments:
        raise InputError(
            f"{reconstructed}: no clip as long as the run's clips has its present at a held-out frame"
        )
    predictor = AgentPredictor(load_agent(run), clips.future_frames, 0)
    seen = RealToSimComparison(predictor, clips.image_hw)
    for done, index in enumerate(moments):
        real = dataset[index]
        now_s = (dataset.now_us(index) - int(t_us[0])) * 1e-6
        seen.add(real, rendered_images(scene, real.clip, now_s, views, cameras))
        on_items(done + 1, len(moments))
    figures = seen.figures(clips.frame_dt_s) | {"moments": len(moments)}
    origin = {"run": str(run.folder), "reconstructed": str(reconstructed), "log": log.name}
    write_summary(out / GAP, figures | collect_provenance() | origin)
    return figures


@torch.no_grad()
def rendered_images(
    scene: ReconstructedScene, clip: Clip, now_s: float, views: Sequence[CameraView], cameras: Sequence[int]
) -> Clip:
    """Return an unbatched clip whose images up to now are rendered from the scene.

    Args:
        scene: the scene without edits.
        clip: a clip of the log that the scene was trained on, with images of the same size as the views.
        now_s: time of the clip's now since the start of the log, s.
        views: views of all frames of that log.
        cameras: for each camera of the clip, the index of the scene's camera.

    Raises:
        InputError: there is no view of a camera at a frame's time.
    """
    images, graph = clip.images.clone(), scene.graph
    late_s = clip.rig.exposed_dt_s
    for frame in range(clip.now + 1):
        for place, camera in enumerate(cameras):
            if not bool(clip.image_valid[frame, place]):
                continue
            at_s = now_s + float(clip.t_s[frame]) + (0.0 if late_s is None else float(late_s[frame, place]))
            view = min((v for v in views if v.sensor == camera), key=lambda v: abs(v.t_s - at_s))
            if abs(view.t_s - at_s) > _SAME_S:
                raise InputError(f"no view of {clip.rig.names[place]} at {at_s:.3f} s of the log")
            images[frame, place] = scene.camera(graph, view.to(scene.device)).rgb_8bit
    return dataclasses.replace(clip, images=images)


class RealToSimComparison:
    """Collects a model's predictions on real and on rendered images of the same times."""

    def __init__(self, predictor: Predictor, image_hw: tuple[int, int]) -> None:
        self._predictor, self._image_hw = predictor, image_hw
        self._examples: list[Example] = []
        self._predictions: dict[str, list[Prediction]] = {REAL: [], RENDERED: []}
        self._psnr_db: list[Tensor] = []

    def add(self, example: Example, rendered: Clip) -> None:
        """Predict one unbatched example with its real and with its rendered images."""
        now, batch = example.clip.now, collate([example])
        for name, clip in ((REAL, example.clip), (RENDERED, rendered)):
            small = dataclasses.replace(example, clip=shrink_images(clip, self._image_hw))
            observed = collate([small]).clip.observed()
            prediction = self._predictor.predict(observed, ASKED)
            self._predictions[name].append(
                Prediction(occupancy_logit=prediction.occupancy_logit, plan=prediction.plan)
            )
        shown, real = (clip.images[now].float() / 255 for clip in (rendered, example.clip))
        valid = example.clip.image_valid[now][:, None, None].expand(-1, *example.clip.rig.size_hw)
        self._psnr_db.append(psnr_db(shown, real, valid))
        self._examples.append(dataclasses.replace(batch, clip=_without_images(batch.clip)))

    def figures(self, frame_dt_s: float) -> Figures:
        """Return the metrics of all comparisons, with the name of the comparison as prefix."""
        agreed = list(map(_as_truth, self._examples, self._predictions[REAL]))
        out: Figures = {"psnr_db": float(torch.cat(self._psnr_db).nanmean())}
        for name, prediction, truth in (
            (REAL, self._predictions[REAL], self._examples),
            (RENDERED, self._predictions[RENDERED], self._examples),
            (AGREEMENT, self._predictions[RENDERED], agreed),
        ):
            summary = evaluate(_StoredPredictions(iter(prediction)), truth, frame_dt_s=frame_dt_s).summary
            kinds = (".iou_", ".l2_") if name == AGREEMENT else (".iou_", ".l2_", ".collision_")
            kept = {key: value for key, value in summary.items() if any(kind in key for kind in kinds)}
            # The true motion belongs to the real labels, not to a prediction in their place
            motion = ("occupancy.moving.", "occupancy.standing.") if name == AGREEMENT else ()
            out |= {
                f"{name}.{key}": value
                for key, value in kept.items()
                if not (key.endswith((*PERSISTENT, f".{CEILING}")) or key.startswith(motion))
            }
        return out


class _StoredPredictions:
    """A predictor that returns given predictions in order."""

    def __init__(self, predictions: Iterator[Prediction]) -> None:
        self._predictions = predictions

    def predict(self, observed: Clip, asked: frozenset[Part]) -> Prediction:
        """Return the next prediction."""
        return next(self._predictions)


def _as_truth(example: Example, prediction: Prediction) -> Example:
    """Return an example whose labels are replaced by a prediction."""
    assert prediction.occupancy_logit is not None
    assert prediction.plan is not None
    values, valid = example.occupancy.values.clone(), example.occupancy.known.clone()
    now = example.clip.now
    span = slice(now, now + prediction.occupancy_logit.shape[1])
    values[:, span, 0] = (prediction.occupancy_logit > 0).to(values)
    valid[:, span] = True
    return dataclasses.replace(
        example,
        clip=dataclasses.replace(example.clip, future=prediction.plan),
        occupancy=VoxelGrid(example.occupancy.spec, values, valid),
    )


def _without_images(clip: Clip) -> Clip:
    return dataclasses.replace(clip, images=clip.images[..., :0])
