"""The real-to-sim gap: what a trained run makes of real images, and of rendered ones of the same moments."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import torch
from torch import Tensor

from foredrive.data import collate
from foredrive.data.cameras import find_camera, pinhole_cameras
from foredrive.data.logs import Log
from foredrive.data.resizing import shrink_images
from foredrive.errors import InputError
from foredrive.evaluation import collect_provenance, evaluate, write_summary
from foredrive.evaluation.predictor import Prediction, Predictor
from foredrive.evaluation.totals import COPIES, Figures
from foredrive.metrics import psnr_db
from foredrive.metrics.protocols import STEP_S, STEPS
from foredrive.rendering.rebuilt import RebuiltScene
from foredrive.rendering.views import CameraView
from foredrive.runs.evaluate.predict import AgentPredictor
from foredrive.runs.open_clips import open_clips
from foredrive.runs.rebuild.rebuilt_run import open_rebuilt, open_run_log, rebuilt_cameras
from foredrive.runs.rebuild.reconstruct import read_material
from foredrive.runs.train.run import Run, load_agent
from foredrive.scene import Clip, Example, VoxelGrid

GAP = "gap.json"
REAL, RENDERED, AGREEMENT = "real", "rendered", "agreement"
_SAME_S = 1e-3
"""Times of one exposure differ by less."""


def measure_gap(
    run: Run, rebuilt: Path, out: Path, on_items: Callable[[int, int], None] = lambda done, of: None
) -> Figures:
    """Let a model look at real and at rendered images of the moments that a rebuilt log has held out.

    Writes `out/gap.json`: what `evaluate` finds on real images (`real.…`) and on rendered ones
    (`rendered.…`), both against the truth, and on rendered ones against what the model says of real ones
    (`agreement.…`). Key frames before now are rendered too, though the scene may have learned from those.

    Args:
        run: whose recipe asks for cameras that were rebuilt.
        rebuilt: folder of a reconstruction, whose log is still there.
        out: a folder.
        on_items: told how many moments are done with, of how many.

    Raises:
        InputError: a camera was not rebuilt, or no clip lies at a moment that was held out.
    """
    scene, (recipe, log) = open_rebuilt(rebuilt).scene, open_run_log(rebuilt)
    material = read_material(recipe, log, (rebuilt / "cache").absolute())
    views = [*material.learned.cameras, *material.held_out.cameras]
    clips = run.recipe.clips
    frames = max(clips.future_frames, round(STEPS * STEP_S / clips.frame_dt_s))
    config = dataclasses.replace(
        clips, image_hw=recipe.image_hw, future_frames=frames, future_images=False, now_stride_s=_SAME_S
    )
    dataset = open_clips([log], config, rebuilt / "cache")
    opened = Log(log)
    names = (_own_names(opened, names) for names in (material.vehicle.rig.names, dataset.camera_names))
    cameras, t_us, every = rebuilt_cameras(*names), opened.t_us, recipe.hold_out_every
    held_us = set(t_us[every - 1 :: every].tolist()) if every else set()
    moments = [k for k in range(len(dataset)) if dataset.now_us(k) in held_us]
    if not moments:
        raise InputError(f"{rebuilt}: no clip of the run's length lies at a moment that was held out")
    predictor = AgentPredictor(load_agent(run), clips.future_frames, 0)
    seen = Comparison(predictor, clips.image_hw)
    for done, index in enumerate(moments):
        real = dataset[index]
        now_s = (dataset.now_us(index) - int(t_us[0])) * 1e-6
        seen.add(real, rendered_images(scene, real.clip, now_s, views, cameras))
        on_items(done + 1, len(moments))
    figures = seen.figures(clips.frame_dt_s) | {"moments": len(moments)}
    origin = {"run": str(run.folder), "rebuilt": str(rebuilt), "log": log.name}
    write_summary(out / GAP, figures | collect_provenance() | origin)
    return figures


@torch.no_grad()
def rendered_images(
    scene: RebuiltScene, clip: Clip, now_s: float, views: Sequence[CameraView], cameras: Sequence[int]
) -> Clip:
    """An unbatched clip with the images up to now as the scene shows them.

    Args:
        scene: as it was learned.
        clip: of the log that it was learned from, at the size of the views' images.
        now_s: when its now is, since the log's start.
        views: of all frames of that log.
        cameras: for each camera of the clip the one of the scene.
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
            rgb = scene(graph, view.to(scene.actor.device)).rgb.clamp(0, 1).cpu()
            images[frame, place] = (255 * rgb).round().to(torch.uint8)
    return dataclasses.replace(clip, images=images)


def _own_names(log: Log, names: Sequence[str]) -> list[str]:
    """What a log itself calls cameras, which may have 123D's names."""
    there = pinhole_cameras(log)
    found = [find_camera(there, name) for name in names]
    return [name if camera is None else camera.camera_name for name, camera in zip(names, found, strict=True)]


class Comparison:
    """What a model says of moments that it is shown twice."""

    def __init__(self, predictor: Predictor, image_hw: tuple[int, int]) -> None:
        self._predictor, self._image_hw = predictor, image_hw
        self._examples: list[Example] = []
        self._said: dict[str, list[Prediction]] = {REAL: [], RENDERED: []}
        self._psnr_db: list[Tensor] = []

    def add(self, example: Example, rendered: Clip) -> None:
        """Show it one moment, unbatched."""
        now, batch = example.clip.now, collate([example])
        for name, clip in ((REAL, example.clip), (RENDERED, rendered)):
            small = dataclasses.replace(example, clip=shrink_images(clip, self._image_hw))
            observed = collate([small]).clip.observed()
            said = self._predictor.predict(observed)
            self._said[name].append(Prediction(occupancy_logit=said.occupancy_logit, plan=said.plan))
        shown, real = (clip.images[now].float() / 255 for clip in (rendered, example.clip))
        known = example.clip.image_valid[now][:, None, None].expand(-1, *example.clip.rig.size_hw)
        self._psnr_db.append(psnr_db(shown, real, known))
        self._examples.append(dataclasses.replace(batch, clip=_without_images(batch.clip)))

    def figures(self, frame_dt_s: float) -> Figures:
        """All of them, under the names of what is compared."""
        agreed = list(map(_as_truth, self._examples, self._said[REAL]))
        out: Figures = {"psnr_db": float(torch.cat(self._psnr_db).nanmean())}
        for name, said, truth in (
            (REAL, self._said[REAL], self._examples),
            (RENDERED, self._said[RENDERED], self._examples),
            (AGREEMENT, self._said[RENDERED], agreed),
        ):
            found = evaluate(_Said(iter(said)), truth, frame_dt_s=frame_dt_s).summary
            kinds = (".iou_", ".l2_") if name == AGREEMENT else (".iou_", ".l2_", ".collision_")
            kept = {key: value for key, value in found.items() if any(kind in key for kind in kinds)}
            out |= {f"{name}.{key}": value for key, value in kept.items() if not key.endswith(COPIES)}
        return out


class _Said:
    """Predictions that were made before, in their order."""

    def __init__(self, predictions: Iterator[Prediction]) -> None:
        self._predictions = predictions

    def predict(self, observed: Clip) -> Prediction:
        """The next one."""
        return next(self._predictions)


def _as_truth(example: Example, said: Prediction) -> Example:
    """An example whose labels are what a model says."""
    assert said.occupancy_logit is not None
    assert said.plan is not None
    values, known = example.occupancy.values.clone(), example.occupancy.known.clone()
    now = example.clip.now
    span = slice(now, now + said.occupancy_logit.shape[1])
    values[:, span, 0] = (said.occupancy_logit > 0).to(values)
    known[:, span] = True
    return dataclasses.replace(
        example,
        clip=dataclasses.replace(example.clip, future=said.plan),
        occupancy=VoxelGrid(example.occupancy.spec, values, known),
    )


def _without_images(clip: Clip) -> Clip:
    return dataclasses.replace(clip, images=clip.images[..., :0])
