"""Figures that published evaluation code gives of seeded data, where it cannot be installed.

    PYTHONPATH=src:tests:. .venv-oracles/bin/python tests/oracles/reference_code.py CHECKOUTS

runs the code itself and writes `reference/*.npz`: the data, and figures under `reference.`. CHECKOUTS holds a
clone of each repository of `COMMITS` under its name, at that commit. The code imports mmcv, mmdet3d and CUDA,
but its figures do not depend on them. So there are stand-ins:

- UniAD: imports that training needs, the base class of its metrics, and counts of cells by class
- MapTR: mmcv's clock and print, one process in place of a pool, and a search tree that returns geometries, as
  that of shapely 1.8 did
- SparseOcc: the CUDA kernel is compiled for the processor, which runs one thread after the other

`test_reference_code.py` compares our metrics with the files.
"""

import ast
import contextlib
import importlib
import io
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import shapely
import torch
from oracles.kernel_on_processor import compiled
from oracles.reference_scenes import (
    AGENT_FRAMES,
    MAP_FRAMES,
    Arrays,
    instance_scene,
    line_set,
    map_scene,
    motion_scene,
    raster_scene,
    ray_scene,
)

from foredrive.scene import Category
from foredrive.tasks.motion.protocols import PROTOCOLS as MOTION
from foredrive.tasks.occupancy.protocols import OCC3D_CLASSES

FOLDER = Path(__file__).with_name("reference")
COMMITS = {
    "UniAD": "dd161b220c22de1c874c3fb8d55979054b24d716",  # github.com/OpenDriveLab/UniAD
    "MapTR": "a6872d8d9670bde17b4b01560f1221f88b443d55",  # github.com/hustvl/MapTR
    "SparseOcc": "af4d9df83bfd1b82c2b095fca793ff7ba49d5e9f",  # github.com/MCG-NJU/SparseOcc
}
PLUGIN = "projects/mmdet3d_plugin"

NAMES = {
    Category.CAR: "car", Category.TRUCK: "truck", Category.BUS: "bus", Category.TRAILER: "trailer",
    Category.CONSTRUCTION_VEHICLE: "construction_vehicle", Category.MOTORCYCLE: "motorcycle",
    Category.BICYCLE: "bicycle", Category.PEDESTRIAN: "pedestrian", Category.BARRIER: "barrier",
}  # fmt: skip
"""Names of nuScenes' detection task."""


@contextlib.contextmanager
def stand_ins(modules: Mapping[str, Any]) -> Iterator[None]:
    """Put stand-ins in the place of modules."""
    before = dict(sys.modules)
    sys.modules.update(modules)
    try:
        yield
    finally:
        for name in modules:
            sys.modules.pop(name)
        sys.modules.update({name: before[name] for name in modules if name in before})


def imported(folder: Path, module: str, modules: Mapping[str, Any]) -> Any:
    """A module of a folder, with its neighbours, but without the folder's `__init__`."""
    package = ModuleType(folder.name)
    package.__path__ = [str(folder)]
    with stand_ins({**modules, folder.name: package}):
        return importlib.import_module(f"{folder.name}.{module}")


def function_of(file: Path, name: str, names: Mapping[str, Any]) -> Any:
    """A function or method of a file, compiled alone, with the global names that it uses."""
    nodes = [node for node in ast.walk(ast.parse(file.read_text())) if getattr(node, "name", None) == name]
    assert len(nodes) == 1, f"{file} has {len(nodes)} of {name}"
    scope = dict(names)
    exec(compile(ast.Module(nodes, []), str(file), "exec"), scope)
    return scope[name]


def uniad_motion(checkout: Path, scene: Arrays) -> Arrays:
    """Figures of UniAD's `MotionEval` for its merged classes; those of EPA are read from what it prints."""
    from nuscenes.eval.common.config import config_factory
    from nuscenes.eval.common.data_classes import EvalBoxes
    from nuscenes.eval.common.loaders import filter_eval_boxes

    missing = ("mmdet3d", "mmdet3d.core", "mmdet3d.core.bbox", "mmdet3d.core.bbox.iou_calculators")
    others = ("pycocotools", "pycocotools.mask", "IPython", "prettytable")
    folder = checkout / PLUGIN / "datasets/eval_utils"
    code = imported(folder, "nuscenes_eval_motion", {name: MagicMock() for name in (*missing, *others)})
    tables = SimpleNamespace(get=lambda table, token: {"anns": []})  # no racks of bicycles
    figures: Arrays = {}
    for mode in ("evaluate", "evaluate_epa"):
        cfg = config_factory("detection_cvpr_2019")
        sides = {}
        for side in ("true", "predicted"):
            made = [_motion_box(code, scene, side, row) for row in range(len(scene[f"{side}.frame"]))]
            boxes = EvalBoxes()
            for frame in range(AGENT_FRAMES):
                boxes.add_boxes(str(frame), [box for box in made if box and box.sample_token == str(frame)])
            sides[side] = filter_eval_boxes(tables, boxes, cfg.class_range)
        run = code.MotionEval.__new__(code.MotionEval)
        run.__dict__.update(cfg=cfg, verbose=False, gt_boxes=sides["true"], pred_boxes=sides["predicted"])
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            metrics, _ = getattr(run, mode)()
        lines = printed.getvalue().splitlines()
        for name in ("car", "pedestrian"):
            if mode == "evaluate":
                errors = ("min_ade_err", "min_fde_err", "miss_rate_err")
                figures |= {f"{name}.{key}": np.array(metrics.get_label_tp(name, key)) for key in errors}
            else:  # a line of counts, then one of EPA
                (row,) = (n for n, line in enumerate(lines) if line.startswith(f"EPA  {name} "))
                figures[f"{name}.epa"] = np.array(float(lines[row].split()[-1]))
                figures[f"{name}.agents"] = np.array(int(lines[row - 1].split()[-1]))
    return figures


def _motion_box(code: Any, scene: Arrays, side: str, row: int) -> Any:
    """One box as UniAD's loaders make it; None for a track below the score at which UniAD writes tracks."""
    xy, future = (scene[f"{side}.{key}"][row].astype(np.float64) for key in ("xy", "future_xy"))
    merged = code.accumulate.__globals__["detection_prediction_category_to_motion_name"]
    common: dict[str, Any] = {
        "sample_token": str(int(scene[f"{side}.frame"][row])),
        "translation": (*xy, 0.0),
        "size": (2.0, 4.0, 1.5),
        "rotation": (1.0, 0.0, 0.0, 0.0),
        "ego_translation": (*xy, 0.0),
        "detection_name": merged(NAMES[Category(int(scene[f"{side}.category"][row]))]),
    }
    if side == "predicted":
        score = float(scene["predicted.score"][row])
        if score < MOTION["uniad"].min_score:
            return None
        return code.DetectionMotionBox(**common, detection_score=score, traj=future)
    steps = int(np.cumprod(scene["true.future_valid"][row]).sum())
    points = 5 if scene["true.seen"][row] else 0
    return code.DetectionMotionBox_modified(**common, num_pts=points, traj=future[:steps])


class _Counted:
    """In place of pytorch_lightning's base class: the states are attributes."""

    def __init__(self, compute_on_step: bool = False) -> None: ...

    def add_state(self, name: str, default: torch.Tensor, dist_reduce_fx: str) -> None:
        setattr(self, name, default.clone())


def _counts_by_class(predicted: torch.Tensor, true: torch.Tensor, classes: int) -> tuple[torch.Tensor, ...]:
    """In place of pytorch_lightning's function: hits, false, true negatives, misses and support."""
    by_class = [(predicted == n, true == n) for n in range(classes)]
    rows = [[p & t, p & ~t, ~p & ~t, ~p & t, t] for p, t in by_class]
    return tuple(torch.tensor([int(row[k].sum()) for row in rows]) for k in range(5))


def uniad_instances(checkout: Path, scene: Arrays) -> Arrays:
    """IoU and panoptic quality of vehicles in the two ranges of `uniad/apis/test.py`."""
    parts = {
        "metrics.metric": SimpleNamespace(Metric=_Counted),
        "metrics.functional.classification": SimpleNamespace(stat_scores_multiple_classes=_counts_by_class),
        "metrics.functional.reduction": SimpleNamespace(reduce=lambda scores, reduction: scores),
    }
    modules: dict[str, Any] = {f"pytorch_lightning.{name}": part for name, part in parts.items()}
    modules |= dict.fromkeys(("pytorch_lightning", "pytorch_lightning.metrics"), MagicMock())
    modules["pytorch_lightning.metrics.functional"] = MagicMock()
    code = imported(checkout / PLUGIN / "uniad/dense_heads/occ_head_plugin", "metrics", modules)
    true, predicted = (torch.from_numpy(scene[side].astype(np.int64)) for side in ("true", "predicted"))
    figures: Arrays = {}
    for name, (first, end) in {"near": (70, 130), "far": (0, 200)}.items():
        cut = (..., slice(first, end), slice(first, end))
        iou, panoptic = code.IntersectionOverUnion(2), code.PanopticMetric(n_classes=2)
        for sample in range(len(true)):
            ours, real = (side[sample : sample + 1][cut].contiguous() for side in (predicted, true))
            iou.update((ours > 0).long(), (real > 0).long())
            panoptic.update(ours, real)
        figures[f"iou_{name}"] = iou.compute()[1].numpy()
        figures[f"vpq_{name}"] = panoptic.compute()["pq"][1].numpy()
    return figures


def uniad_raster(checkout: Path, scene: Arrays) -> Arrays:
    """IoU of the layers, which `forward_test` counts frame by frame and the data set's `evaluate` sums."""
    heads = checkout / PLUGIN / "uniad/dense_heads"
    iou = function_of(heads / "seg_head_plugin/seg_utils.py", "IOU", {})
    forward_test = function_of(heads / "panseg_head.py", "forward_test", {"torch": torch, "IOU": iou})
    total: dict[str, Any] = {}
    for true, predicted in zip(scene["true"], scene["predicted"], strict=True):
        masks = torch.from_numpy(true.astype(np.int32))
        layers = torch.from_numpy(predicted.astype(np.int32))
        head = MagicMock()
        head.get_bboxes.return_value = [{"drivable": layers[3], "lane": layers[:3]}]
        labels = torch.tensor([0, 1, 2, 3])
        (counted,) = forward_test(
            head, gt_lane_labels=[labels[None]], gt_lane_masks=[masks[None]], img_metas=[None]
        )
        for key, value in counted["ret_iou"].items():
            total[key] = total.get(key, 0) + value
    return {
        name: (total[f"{name}_intersection"] / total[f"{name}_union"]).numpy()
        for name in ("drivable", "lanes", "divider", "crossing", "contour")
    }


class _Pool:
    """In place of a pool of processes."""

    def __init__(self, processes: int) -> None: ...

    def starmap(self, function: Any, items: Any) -> list[Any]:
        return [function(*item) for item in items]

    def close(self) -> None: ...


class _Tree:
    """In place of shapely's tree, whose `query` returned geometries before shapely 2."""

    def __init__(self, geometries: list[Any]) -> None:
        self.geometries, self.tree = geometries, shapely.STRtree(geometries)

    def query(self, geometry: Any) -> list[Any]:
        return [self.geometries[n] for n in self.tree.query(geometry)]


def maptr(checkout: Path, scene: Arrays) -> Arrays:
    """Average precision of each class at each distance, and the mean without absent classes at each."""
    stand = {name: MagicMock() for name in ("mmcv", "mmcv.utils", "terminaltables")}
    stand |= {name: MagicMock() for name in ("mmdet", "mmdet.core", "mmdet.core.evaluation")}
    stand["mmdet.core.evaluation.bbox_overlaps"] = MagicMock()
    folder = checkout / PLUGIN / "datasets/map_utils"
    code = imported(folder, "mean_ap", stand)
    code.Pool = _Pool
    code.custom_tpfp_gen.__globals__["custom_polyline_score"].__globals__["STRtree"] = _Tree
    code.mmcv.Timer.return_value.since_start.return_value = 0.0
    code.mmcv.Timer.return_value.since_last_check.return_value = 0.0
    sides = {}
    for side in ("predicted", "true"):
        lines, sides[side] = line_set(scene, side), [{"vectors": list[Any]()} for _ in range(MAP_FRAMES)]
        for n, line in enumerate(lines.lines):
            vector = {"pts": line, "type": int(lines.kind[n]), "confidence_level": lines.score[n]}
            sides[side][lines.frame[n]]["vectors"].append(vector)
    classes = ["divider", "ped_crossing", "boundary"]
    with contextlib.redirect_stdout(io.StringIO()):
        lines_by_class = code.format_res_gt_by_classes(
            "results.json",
            sides["predicted"],
            sides["true"],
            cls_names=classes,
            eval_use_same_gt_sample_num_flag=True,
        )
        results = [
            code.eval_map(
                sides["predicted"],
                sides["true"],
                *lines_by_class,
                threshold,
                classes,
                "silent",
                metric="chamfer",
            )
            for threshold in (0.5, 1.0, 1.5)
        ]
    ap = np.array([[by_class["ap"] for by_class in classes_at] for _, classes_at in results])
    return {"ap": ap, "mean_ap": np.array([mean for mean, _ in results])}


def sparseocc_rays(checkout: Path, scene: Arrays) -> Arrays:
    """RayIoU at each distance, and in the mean. Tensors stay on the processor."""
    kernel = compiled(checkout / "lib/dvr/dvr.cu")
    stand = {
        "torch.utils.cpp_extension": SimpleNamespace(load=lambda *_, **__: kernel),
        "prettytable": MagicMock(),
    }
    code = imported(checkout / "loaders", "ray_metrics", stand)
    true, predicted = (
        [np.ascontiguousarray(labels.transpose(2, 1, 0)) for labels in scene[side]]
        for side in ("true", "predicted")
    )
    origins = [torch.from_numpy(places_m)[None] for places_m in scene["origins_m"]]
    to_device, torch.Tensor.cuda = torch.Tensor.cuda, lambda tensor: tensor  # type: ignore[method-assign, assignment]
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            figures = code.main_rayiou(predicted, true, origins, OCC3D_CLASSES)
    finally:
        torch.Tensor.cuda = to_device  # type: ignore[method-assign]
    return {key.lower().replace("@", "_"): np.array(value) for key, value in figures.items()}


METRICS = {
    "uniad_motion": ("UniAD", motion_scene, uniad_motion, (0, 1, 2)),
    "uniad_instances": ("UniAD", instance_scene, uniad_instances, (3,)),
    "uniad_raster": ("UniAD", raster_scene, uniad_raster, (4,)),
    "maptr": ("MapTR", map_scene, maptr, (5, 6)),
    "sparseocc_rays": ("SparseOcc", ray_scene, sparseocc_rays, (7,)),
}
"""Repository, inputs, figures and seeds of each file."""


def main(checkouts: Path) -> None:
    for name, commit in COMMITS.items():
        head = subprocess.check_output(
            ["git", "-C", checkouts / name, "rev-parse", "HEAD"], text=True
        ).strip()
        assert head == commit, f"{name} is at {head}, not at {commit}"
    FOLDER.mkdir(exist_ok=True)
    for metric, (repository, scene_of, figures_of, seeds) in METRICS.items():
        for seed in seeds:
            scene = scene_of(seed)
            figures = figures_of(checkouts / repository, scene)
            reference = {f"reference.{key}": value for key, value in figures.items()}
            np.savez_compressed(FOLDER / f"{metric}_{seed}.npz", **scene, **reference)
            print(metric, seed, {key: value.tolist() for key, value in figures.items()})


if __name__ == "__main__":
    main(Path(sys.argv[1]))
