"""nuscenes-devkit 1.2.0 on drives in memory: its filter, tracks, matching and averages, without its data."""

from typing import Any

import numpy as np

from benchmarks.common.object_drives import RACK, Drives, detection_boxes, tracking_boxes


class FakeTables:
    """Answer the devkit's requests to its tables: scenes of the validation split, samples, bicycle racks."""

    def __init__(self, drives: Drives) -> None:
        from nuscenes.utils.splits import val

        self.version = "v1.0-trainval"
        tokens: dict[int, list[str]] = {}
        for token, scene in drives.scene_of.items():
            tokens.setdefault(scene, []).append(token)
        self.tables: dict[str, dict[str, Any]] = {"scene": {}, "sample": {}, "sample_annotation": {}}
        for scene, members in tokens.items():
            self.tables["scene"][f"scene{scene}"] = {
                "token": f"scene{scene}",
                "name": val[scene],
                "first_sample_token": members[0],
                "last_sample_token": members[-1],
            }
            for token, after in zip(members, [*members[1:], ""], strict=True):
                self.tables["sample"][token] = {
                    "token": token,
                    "scene_token": f"scene{scene}",
                    "timestamp": drives.timestamp[token],
                    "next": after,
                    "anns": [f"{token} {n}" for n in range(len(drives.racks[token]))],
                }
        for token, racks in drives.racks.items():
            for n, rack in enumerate(racks):
                self.tables["sample_annotation"][f"{token} {n}"] = {**rack, "category_name": RACK}
        self.scene, self.sample = [*self.tables["scene"].values()], [*self.tables["sample"].values()]

    def get(self, table: str, token: str) -> Any:
        """Return a row, as NuScenes.get."""
        return self.tables[table][token]


def detection(drives: Drives, region: str = "circle") -> dict[str, Any]:
    """The devkit's metrics_summary of detections; "rectangle" takes VAD's ranges."""
    metrics, _ = prepare_detection(drives, region).evaluate()
    summary: dict[str, Any] = metrics.serialize()
    summary.pop("cfg"), summary.pop("eval_time")
    return summary


def prepare_detection(drives: Drives, region: str = "circle") -> Any:
    """A DetectionEval whose boxes are filtered, by the devkit's filter."""
    from nuscenes.eval.common import loaders
    from nuscenes.eval.common.config import config_factory
    from nuscenes.eval.common.data_classes import EvalBoxes
    from nuscenes.eval.detection.data_classes import DetectionBox
    from nuscenes.eval.detection.evaluate import DetectionEval

    cfg = config_factory("detection_cvpr_2019")
    boxes = []
    for members in (drives.detections, drives.truth):
        content = {token: detection_boxes(each) for token, each in members.items()}
        if region == "rectangle":  # as VAD's filter_eval_boxes: ranges along two axes come first
            content = {
                token: [b for b in each if np.all(np.abs(b["ego_translation"][:2]) < (30, 15))]
                for token, each in content.items()
            }
        reach = cfg.class_range if region == "circle" else dict.fromkeys(cfg.class_range, float("inf"))
        read = EvalBoxes.deserialize(content, DetectionBox)
        boxes.append(loaders.filter_eval_boxes(FakeTables(drives), read, reach))
    run = DetectionEval.__new__(DetectionEval)
    run.__dict__.update(pred_boxes=boxes[0], gt_boxes=boxes[1], cfg=cfg, verbose=False)
    return run


def tracking(drives: Drives, min_score: float = 0.0) -> dict[str, Any]:
    """The devkit's metrics_summary of tracks of at least a score, and its figures at every recall."""
    evaluation = prepare_tracking(drives, min_score)
    metrics, details = evaluation.evaluate()
    summary: dict[str, Any] = metrics.serialize()
    summary.pop("cfg"), summary.pop("eval_time")
    return {**summary, "details": details.serialize()}


def prepare_tracking(drives: Drives, min_score: float = 0.0) -> Any:
    """A TrackingEval whose tracks are made, by the devkit's filter and interpolation."""
    from nuscenes.eval.common import loaders
    from nuscenes.eval.common.config import config_factory
    from nuscenes.eval.common.data_classes import EvalBoxes
    from nuscenes.eval.tracking.data_classes import TrackingBox
    from nuscenes.eval.tracking.evaluate import TrackingEval
    from nuscenes.eval.tracking.loaders import create_tracks

    cfg = config_factory("tracking_nips_2019")
    tables, tracks = FakeTables(drives), []
    for members, gt in ((drives.truth, True), (drives.tracks, False)):
        kept = {t: [b for b in each if gt or b["score"] >= min_score] for t, each in members.items()}
        content = {t: tracking_boxes(each, tuple(cfg.tracking_names)) for t, each in kept.items()}
        read = EvalBoxes.deserialize(content, TrackingBox)
        boxes = loaders.filter_eval_boxes(tables, read, cfg.class_range)
        tracks.append(create_tracks(boxes, tables, "val", gt=gt))
    run = TrackingEval.__new__(TrackingEval)
    state = {"tracks_gt": tracks[0], "tracks_pred": tracks[1], "cfg": cfg, "verbose": False}
    run.__dict__.update({**state, "output_dir": "", "render_classes": []})
    return run
