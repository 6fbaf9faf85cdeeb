"""Predictions of an evaluation as results files in public formats, which `foredrive score` reads.

- `detection.json`: nuScenes' submissions (detection_name, detection_score, attribute_name)
- `tracking.json`: nuScenes' submissions (tracking_name, tracking_score, tracking_id); with identities only
- `motion.json`: boxes with futures as UniAD writes them (predict_traj, predict_traj_score), in world frame
- `map.json`: MapTR's results, in the ego frame
- `occupancy/LOG@T_US.npz`: `semantics`, as Occ3D's, and `flow`, as OpenOcc's, X Y Z; `occupancy/grid.json`
  states classes, grid and the cameras of the camera mask
Frames are named LOG@T_US, and the world frame is that of the log.
"""

import contextlib
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray
from torch import Tensor

from foredrive.engine.summary import write_json
from foredrive.files import atomic_path
from foredrive.scene import Attribute, Category, Example
from foredrive.scene.agents import Agents, MapLines
from foredrive.scene.map_elements import ElementKind
from foredrive.scene.semantics import SemanticVoxels
from foredrive.tasks.maps.map_lines_metric import AREA
from foredrive.tasks.maps.protocols import HALF_XY_M
from foredrive.tasks.objects.in_world import (
    Pose,
    ego_yaw,
    futures_in_world,
    likely,
    places_in_world,
    velocities_in_world,
)
from foredrive.tasks.objects.object_rows import DETECTION_CLASSES
from foredrive.tasks.occupancy.log_results import GRID_FILE, VoxelGridOfResults, write_grid, write_voxels
from foredrive.tasks.predictor import Prediction
from foredrive.tasks.tracking.protocols import TRACKING_PROTOCOLS

MAPTR_NAMES = {
    ElementKind.DIVIDER: "divider",
    ElementKind.CROSSING: "ped_crossing",
    ElementKind.BOUNDARY: "boundary",
    ElementKind.CENTRELINE: "centerline",
}
TRACKED = TRACKING_PROTOCOLS["nuscenes"].classes
WITHOUT_ATTRIBUTE = ("traffic_cone", "barrier")
META = {"use_camera": True, "use_lidar": False, "use_radar": False, "use_map": False, "use_external": False}
"""Our models see cameras alone."""

DIGITS = 6
"""Digits after the point of futures and polylines, m: most of the numbers in the files."""

TASKS = ("detection", "tracking", "motion", "map")
"""Tasks with one JSON file each."""
OCCUPANCY = "occupancy"
"""Folder of semantic voxels in the folder of the files."""

Record = dict[str, Any]


class ResultsFiles:
    """Collects the predictions of an evaluation batch by batch, and writes them.

    Frames that the log does not annotate are left out, unless it annotates none: then all frames are written.

    Args:
        folder: an empty folder for the files. Voxels are written to it at once.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._frames: dict[str, dict[str, tuple[bool, list[Record]]]] = {}
        self._voxels: dict[Path, bool] = {}

    @classmethod
    @contextlib.contextmanager
    def written_to(cls, folder: Path) -> Iterator["ResultsFiles"]:
        """Collect predictions in a block, and let all their files appear at its end, or none if it raises.

        The files of an earlier evaluation are removed then: scored with the new ones, they would count as
        predictions. Other files in the folder stay.
        """
        # The files appear together at the end of the block, in place of those before
        with atomic_path(folder) as scratch:
            scratch.mkdir()
            files = cls(scratch)
            yield files
            files._write()
            earlier = {folder / f"{task}.json" for task in TASKS} | {folder / OCCUPANCY / GRID_FILE}
            earlier |= set((folder / OCCUPANCY).rglob("*@*.npz"))
            # Files of others in the folder are kept
            for other in (path for path in folder.rglob("*") if path.is_file() and path not in earlier):
                kept = scratch / other.relative_to(folder)
                kept.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(other, kept)

    def add(self, prediction: Prediction, truth: Example) -> None:
        """Add a batch of b predictions with their truth."""
        clip = truth.clip
        for item, token in enumerate(truth.key):
            annotated = bool(clip.boxes_valid[item, clip.now])
            if prediction.agents is not None:
                agents = likely(prediction.agents[item].to("cpu"))
                pose = clip.T_world_ego[item, clip.now].cpu().numpy()
                for task, records in _agent_records(token, agents, pose).items():
                    # The first item of the pair tells whether the frame can be judged
                    self._frames.setdefault(task, {})[token] = (annotated, records)
            if prediction.map_lines is not None:
                elements = None if truth.truth is None else truth.truth.elements
                known = elements is not None and bool(elements.known[item])
                vectors = _vectors(prediction.map_lines[item].to("cpu"))
                self._frames.setdefault("map", {})[token] = (known, vectors)
            # Voxels are written at once, as they are large
            semantics = None if truth.truth is None else truth.truth.semantics
            if prediction.semantics is not None and semantics is not None:
                flow = None if prediction.flow_mps is None else prediction.flow_mps[item, 0, :2]
                self._add_voxels(token, prediction.semantics[item], flow, semantics[item], clip.rig.names)

    def _add_voxels(
        self,
        token: str,
        labels: UInt8[Tensor, "Z Y X"],
        flow_mps: Float[Tensor, "2 Z Y X"] | None,
        truth: SemanticVoxels,
        cameras: tuple[str, ...],
    ) -> None:
        """Write the voxels of one frame."""
        folder = self.folder / OCCUPANCY
        if not self._voxels:
            write_grid(folder, VoxelGridOfResults(truth.taxonomy, truth.spec, cameras))
        path = folder / f"{token}.npz"
        flow = None if flow_mps is None else flow_mps.cpu().numpy()
        write_voxels(path, labels.cpu().numpy(), flow, truth.taxonomy)
        self._voxels[path] = bool(truth.known.any())

    def _write(self) -> None:
        """Write the files of the tasks that the model predicts."""
        for task, frames in self._frames.items():
            if task == "tracking" and not any(records for _, records in frames.values()):
                continue  # the model gives no identities
            meta: dict[str, object] = dict(META)
            content: object = {"meta": meta, "results": _judged(frames)}
            if task == "map":
                area_m = [2 * half_m for half_m in HALF_XY_M[AREA]]
                vectors = [
                    {"sample_token": token, "vectors": frame_vectors}
                    for token, frame_vectors in _judged(frames).items()
                ]
                content = {"meta": meta | {"area_m": area_m}, "results": vectors}
            write_json(self.folder / f"{task}.json", content, indent=None)
        # Voxels of unlabelled frames are removed if others have labels
        if any(self._voxels.values()):
            for path in (path for path, written in self._voxels.items() if not written):
                path.unlink()


def _judged(frames: Mapping[str, tuple[bool, list[Record]]]) -> dict[str, list[Record]]:
    some = any(judged for judged, _ in frames.values())
    return {token: records for token, (judged, records) in frames.items() if judged or not some}


def _agent_records(token: str, agents: Agents, T_world_ego: Pose) -> dict[str, list[Record]]:
    """Return the boxes of one frame by task."""
    boxes, names = _box_records(token, agents, T_world_ego), _names(agents)
    scores = agents.score.double().tolist()
    records: dict[str, list[Record]] = {
        "detection": [
            box | {"detection_name": name, "detection_score": score, "attribute_name": attribute}
            for box, name, score, attribute in zip(
                boxes, names, scores, _attributes(agents, names), strict=True
            )
        ]
    }
    records["tracking"] = [
        box | {"tracking_id": str(track), "tracking_name": name, "tracking_score": score}
        for box, name, score, track in zip(boxes, names, scores, agents.track_id.tolist(), strict=True)
        if track >= 0 and name in TRACKED
    ]
    if agents.future_xy is not None and agents.log_prob is not None:
        # Futures are offsets of centres in the ego frame: move them to the world
        centre = agents.centre.double().numpy()
        futures = futures_in_world(agents.future_xy.double().numpy(), centre, T_world_ego)
        probabilities = agents.log_prob.double().exp().numpy()
        records["motion"] = [
            {
                **_chosen(box, ("sample_token", "translation")),
                **_chosen(record, ("detection_name", "detection_score")),
                "predict_traj": future.round(DIGITS).tolist(),
                "predict_traj_score": probability.tolist(),
            }
            for box, record, future, probability in zip(
                boxes, records["detection"], futures, probabilities, strict=True
            )
        ]
    return records


def _box_records(token: str, agents: Agents, T_world_ego: Pose) -> list[Record]:
    """Return what detections and tracks share: places, sizes, rotations and velocities in the world frame."""
    centre = places_in_world(agents.centre.double().numpy(), T_world_ego)
    # Half angles for a quaternion about the vertical axis
    half_yaw = 0.5 * (agents.yaw.double().numpy() + ego_yaw(T_world_ego))
    velocity = velocities_in_world(agents.velocity.double().numpy(), T_world_ego)
    # nuScenes writes width, length, height
    size_wlh = agents.size_lwh.double().numpy()[:, [1, 0, 2]]
    rotation = _rotations(half_yaw)
    columns = {"translation": centre, "size": size_wlh, "rotation": rotation, "velocity": velocity}
    return [
        {"sample_token": token, **{name: column[n].tolist() for name, column in columns.items()}}
        for n in range(len(centre))
    ]


# Quaternion w x y z
def _rotations(half_yaw: Float[ndarray, "n"]) -> Float[ndarray, "n 4"]:
    zero = np.zeros_like(half_yaw)
    return np.stack([np.cos(half_yaw), zero, zero, np.sin(half_yaw)], axis=1)


def _names(agents: Agents) -> list[str]:
    names = [Category(kind).name.lower() for kind in agents.category.tolist()]
    assert set(names) <= set(DETECTION_CLASSES), "heads predict nuScenes' ten classes"
    return names


def _attributes(agents: Agents, names: Sequence[str]) -> list[str]:
    """Return the names of attributes; the empty name for classes that have none, or where it is unknown."""
    stated = zip(agents.attribute.tolist(), names, strict=True)
    return ["" if kind < 0 or name in WITHOUT_ATTRIBUTE else Attribute(kind).label for kind, name in stated]


def _chosen(record: Record, keys: Sequence[str]) -> Record:
    return {key: record[key] for key in keys}


def _vectors(lines: MapLines) -> list[Record]:
    points, kinds = lines.points.double().numpy().round(DIGITS).tolist(), lines.kind.tolist()
    return [
        {
            "pts": line,
            "pts_num": len(line),
            "cls_name": MAPTR_NAMES[ElementKind(kind)],
            "type": kind,
            "confidence_level": score,
        }
        for line, kind, score in zip(points, kinds, lines.score.double().tolist(), strict=True)
    ]
