"""Forecast agents in nuScenes' results format with futures, as UniAD, SparseDrive and MFEval write them.

A file has lists of boxes by sample token, under `results` or alone. A box has `translation` (m, global), a
name (`detection_name`, `tracking_name` or `class_name`) and, if predicted, a score (`detection_score` or
`tracking_score`), its futures [K, T, 2] at steps of 0.5 s (`predict_traj`, `trajs` or `traj`) and, if it has
them, their probabilities (`predict_traj_score` or `traj_prob`).

In the truth, `traj` [T, 2] is the future up to the first step without annotation, and `num_pts` the number
of sensor points. Regions need the place of the ego vehicle: `ego_poses` by token (`translation`, `rotation`
as w x y z) beside `results`, or `ego_translation` of the boxes, as the devkit writes it. The latter has no
heading, without which VAD's rectangle cannot be placed.

Futures are in the global frame; or, as UniAD's, in the lidar's in both files. They can be compared then, but
not with places, so that what needs both (moving vehicles) is left out.

The truth may also be a folder of 123D logs: frames are named LOG@T_US then, and places and futures are in the
log's world frame.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from foredrive.data.boxes import read_boxes
from foredrive.data.truth.agent_futures import read_futures
from foredrive.errors import InputError
from foredrive.scene import Boxes, Category
from foredrive.scene.agent_futures import AgentFutures
from foredrive.tasks.files.frames_of_results import check_known_frames, log_frames
from foredrive.tasks.files.plain_files import read_number_rows, read_numbers
from foredrive.tasks.motion.agents import PredictedAgents, TrueAgents
from foredrive.tasks.motion.protocols import STEP_S
from foredrive.tasks.objects.in_world import ego_yaw, futures_in_world, places_in_world
from foredrive.tasks.objects.nuscenes_json import boxes_by_frame, read_object

STEPS = 12
NAMES = ("detection_name", "tracking_name", "class_name")
SCORES = ("detection_score", "tracking_score")
FUTURES = ("predict_traj", "trajs", "traj")
PROBABILITIES = ("predict_traj_score", "traj_prob")
CATEGORIES = {
    category.name.lower(): category
    for category in Category
    if category not in (Category.ANIMAL, Category.OTHER)
}
FAR_M = 100.0
"""A future whose first step is farther from the place of its box is in another frame."""

Box = Mapping[str, Any]


@dataclass(frozen=True)
class AgentFiles:
    """Predicted and true agents of the truth's frames."""

    predicted: PredictedAgents
    true: TrueAgents
    frames: int
    frames_without_results: int
    heading_known: bool
    """False if the truth has the place of the ego vehicle but not its heading."""
    futures_placed: bool
    """False if futures are in another frame than boxes."""


@dataclass(frozen=True)
class _Rows:
    """Boxes of one file in order of the truth's frames."""

    records: Sequence[Box]
    names: Sequence[str]
    frame: Int[ndarray, "n"]
    category: Int[ndarray, "n"]
    xy: Float[ndarray, "n 2"]
    """Global, m."""


def read_agents(results: Path, truth: Path) -> AgentFiles:
    """Read predicted and true agents.

    Raises:
        InputError: a file cannot be read, or an entry is wrong. The message names both.
    """
    boxes = boxes_by_frame(results, read_object(results))
    if truth.is_dir():
        return _against_logs(boxes, results, truth)
    true_content = read_object(truth)
    true_boxes = boxes_by_frame(truth, true_content)
    check_known_frames(results, boxes, truth, list(true_boxes))
    if not true_boxes:
        raise InputError(f"{truth}: holds no frames")
    tokens = list(true_boxes)
    rows, true_rows = _rows(boxes, tokens, results), _rows(true_boxes, tokens, truth)
    ego = _ego(true_content, true_rows, rows, tokens, truth)
    future_xy, valid = _true_futures(true_rows)
    # A box without a number of points counts as seen
    seen = np.array([box.get("num_pts", -1) != 0 for box in true_rows.records], dtype=bool)
    true = TrueAgents(true_rows.frame, true_rows.category, true_rows.xy, future_xy, valid, seen)
    missing = len(set(true_boxes) - set(boxes))
    return _in_ego_frame(rows, true, true_rows.names, ego, missing)


def _in_ego_frame(
    rows: _Rows, true: TrueAgents, true_names: Sequence[str], ego: "_Ego", frames_without_results: int
) -> AgentFiles:
    """Bring both sides, global so far, into the ego frames."""
    # Futures that begin near their boxes are in the global frame; others are in a frame of their own
    futures = _predicted_futures(rows)
    placed = _placed(rows, futures[:, :, 0], true, true_names)
    future_xy = ego.frame_of(futures, rows.frame) if placed else futures
    true_future_xy = ego.frame_of(true.future_xy, true.frame) if placed else true.future_xy
    return AgentFiles(
        predicted=PredictedAgents(
            rows.frame,
            rows.category,
            _scores(rows),
            ego.frame_of(rows.xy, rows.frame),
            future_xy,
            _probabilities(rows, futures.shape[1]),
        ),
        true=dataclasses.replace(
            true,
            xy=ego.frame_of(true.xy, true.frame),
            # Unknown steps are set to 0
            future_xy=true_future_xy * true.future_valid[..., None],
        ),
        frames=len(ego.xy),
        frames_without_results=frames_without_results,
        heading_known=bool(np.isfinite(ego.yaw).all()),
        futures_placed=placed,
    )


def _against_logs(boxes: Mapping[str, Sequence[Box]], results: Path, truth: Path) -> AgentFiles:
    """Return predictions and the agents of logs at their frames."""
    frames = list(log_frames(truth, boxes, results))
    agents, names, ego_xy, headings = [], [], [], []
    # Frames of logs have truth in the world frame of their log
    for number, frame in enumerate(frames):
        logged = read_boxes(frame.log, frame.frame)
        if logged is None:
            raise InputError(f"{results}: frame {frame.name} is not annotated in {frame.log.path.folder}")
        future = read_futures(frame.log, frame.frame, STEPS, STEP_S)
        T_world_ego = frame.log.T_world_ego[frame.frame]
        agents.append(_agents_of_log(logged, future, T_world_ego, number))
        names += [f"{truth}: frame {frame.name}, box {n}" for n in range(len(agents[-1].frame))]
        ego_xy.append(T_world_ego[:2, 3])
        headings.append(ego_yaw(T_world_ego))
    rows = _rows(boxes, [frame.name for frame in frames], results)
    if not agents:
        raise InputError(f"{results}: holds no frames")
    fields = [field.name for field in dataclasses.fields(TrueAgents)]
    true = TrueAgents(**{key: np.concatenate([getattr(a, key) for a in agents]) for key in fields})
    return _in_ego_frame(rows, true, names, _Ego(np.array(ego_xy), np.array(headings)), 0)


def _agents_of_log(
    boxes: Boxes, futures: AgentFutures, T_world_ego: Float[ndarray, "4 4"], frame: int
) -> TrueAgents:
    """Return the boxes of a frame with their futures, in the log's world frame."""
    centre = boxes.centre.double().numpy()
    return TrueAgents(
        np.full(len(centre), frame),
        boxes.category.numpy().astype(np.int64),
        places_in_world(centre, T_world_ego)[:, :2],
        futures_in_world(futures.xy.double().numpy(), centre, T_world_ego),
        futures.valid.numpy(),
        boxes.num_points.numpy() != 0,
    )


@dataclass(frozen=True)
class _Ego:
    """Place (global, m) and heading of the ego vehicle in each frame; NaN where the heading is unknown."""

    xy: Float[ndarray, "F 2"]
    yaw: Float[ndarray, "F"]

    def frame_of(self, xy: Float[ndarray, "n *s 2"], frame: Int[ndarray, "n"]) -> Float[ndarray, "n *s 2"]:
        """Return global places in the ego frames, or along global axes if there are no headings."""
        # The ego pose broadcasts over steps and modes
        extra = (slice(None), *[None] * (xy.ndim - 2))
        offset = xy - self.xy[frame][extra]
        yaw = np.nan_to_num(self.yaw)[frame][extra]
        cos, sin = np.cos(yaw), np.sin(yaw)
        x, y = offset[..., 0], offset[..., 1]
        # Rotation by -yaw; without a heading, yaw counts as 0
        return np.stack([cos * x + sin * y, cos * y - sin * x], axis=-1)


def _rows(boxes: Mapping[str, Sequence[Box]], tokens: Sequence[str], path: Path) -> _Rows:
    records, names, frame, category = [], [], [], []
    for number, token in enumerate(tokens):
        for n, box in enumerate(boxes.get(token, ())):
            where = f"{path}: frame {token}, box {n}"
            name = _first(box, NAMES)
            if name not in CATEGORIES:
                raise InputError(f"{where}: the class {name!r} is not one of {', '.join(CATEGORIES)}")
            records.append(box)
            names.append(where)
            frame.append(number)
            category.append(int(CATEGORIES[name]))
    place = [{"translation": _planar(box["translation"])} if "translation" in box else {} for box in records]
    xy = read_number_rows(place, "translation", 2, names)
    return _Rows(records, names, np.array(frame, dtype=np.int64), np.array(category, dtype=np.int64), xy)


def _first(box: Box, keys: Sequence[str]) -> Any:
    return next((box[key] for key in keys if key in box), None)


def _planar(value: Any) -> Any:
    """Return x and y of a place, which may have a height."""
    return value[:2] if isinstance(value, list) and len(value) in (2, 3) else value


def _scores(rows: _Rows) -> Float[ndarray, "n"]:
    scores = [_first(box, SCORES) for box in rows.records]
    stated = [{} if value is None else {"score": value} for value in scores]
    score = read_number_rows(stated, "score", 1, rows.names)[:, 0]
    wrong = np.flatnonzero((score < 0) | (score > 1))
    if len(wrong):
        raise InputError(f"{rows.names[wrong[0]]}: the score {score[wrong[0]]:g} is not in [0, 1]")
    return score


def _predicted_futures(rows: _Rows) -> Float[ndarray, "n K T 2"]:
    stated = [_first(box, FUTURES) for box in rows.records]
    if not stated:
        return np.zeros((0, 1, STEPS, 2))
    shape: tuple[int, ...] = ()
    futures: list[ndarray] = []
    for where, value in zip(rows.names, stated, strict=True):
        box_futures = _numbers(value, where, "futures")
        if (
            box_futures.ndim != 3
            or box_futures.shape[2] != 2
            or not box_futures.shape[0]
            or box_futures.shape[1] < STEPS
        ):
            raise InputError(f"{where}: its futures are not [K, {STEPS}, 2] (x, y at steps of 0.5 s)")
        shape = box_futures.shape if not futures else shape
        if box_futures.shape != shape:
            raise InputError(
                f"{where}: its futures are {list(box_futures.shape)}, those before {list(shape)}"
            )
        futures.append(box_futures[:, :STEPS])
    return np.stack(futures)


def _probabilities(rows: _Rows, futures: int) -> Float[ndarray, "n K"]:
    # Without probabilities, all futures are equally likely
    probabilities = np.full((len(rows.records), futures), 1.0 / futures)
    for n, (where, box) in enumerate(zip(rows.names, rows.records, strict=True)):
        stated = _first(box, PROBABILITIES)
        if stated is not None:
            stated_values = _numbers(stated, where, "probabilities of its futures").reshape(-1)
            if len(stated_values) != futures:
                raise InputError(f"{where} has {len(stated_values)} probabilities for {futures} futures")
            probabilities[n] = stated_values
    return probabilities


def _true_futures(rows: _Rows) -> tuple[Float[ndarray, "n T 2"], Bool[ndarray, "n T"]]:
    futures = np.zeros((len(rows.records), STEPS, 2))
    valid = np.zeros((len(rows.records), STEPS), dtype=bool)
    for n, (where, box) in enumerate(zip(rows.names, rows.records, strict=True)):
        if "traj" not in box:
            raise InputError(f"{where} has no traj: the truth states each agent's future, which may be empty")
        values = _numbers(box["traj"], where, "traj")
        if values.size and (values.ndim != 2 or values.shape[1] != 2):
            raise InputError(f"{where}: its traj is not [T, 2]")
        steps = min(len(values), STEPS)
        futures[n, :steps] = values[:steps].reshape(-1, 2)
        valid[n, :steps] = True
    return futures, valid


def _numbers(value: Any, where: str, what: str) -> ndarray:
    try:
        numbers = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{where}: its {what} are not numbers") from error
    if not np.isfinite(numbers).all():
        raise InputError(f"{where}: its {what} are not finite")
    return numbers


def _placed(
    rows: _Rows, first_steps: Float[ndarray, "n K 2"], true: TrueAgents, true_names: Sequence[str]
) -> bool:
    """Return whether futures are in the frame of the boxes. Both files must agree on it."""
    # Agents with a known first step decide about the truth's frame
    rows_with_future = np.flatnonzero(true.future_valid[:, 0])
    near = np.linalg.norm(first_steps - rows.xy[:, None], axis=-1).min(axis=1) < FAR_M
    true_near = (
        np.linalg.norm(true.future_xy[rows_with_future, 0] - true.xy[rows_with_future], axis=-1) < FAR_M
    )
    placed = bool(true_near.all())
    if not placed and true_near.any():
        name = true_names[rows_with_future[np.flatnonzero(~true_near)[0]]]
        raise InputError(f"{name}: its traj begins more than {FAR_M:g} m from its translation")
    wrong = np.flatnonzero(near != placed)
    if len(wrong):
        raise InputError(
            f"{rows.names[wrong[0]]}: its futures are not in the same frame as those of the truth"
        )
    return placed


def _ego(
    content: Mapping[str, Any], true: _Rows, predicted: _Rows, tokens: Sequence[str], path: Path
) -> _Ego:
    """Return place and heading of the ego vehicle as the files state them."""
    xy, yaw = np.full((len(tokens), 2), np.nan), np.full(len(tokens), np.nan)
    # Place and heading from the poses, if there are any
    poses = content.get("ego_poses", {})
    for number, token in enumerate(tokens):
        pose = poses.get(token) if isinstance(poses, dict) else None
        if isinstance(pose, dict):
            where = f"{path}: frame {token}, its ego pose"
            xy[number] = read_numbers(pose, "translation", 3, where)[:2]
            w, x, y, z = read_numbers(pose, "rotation", 4, where)
            yaw[number] = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))
    # Otherwise the place follows from a box: its position minus its position relative to the ego vehicle
    for rows in (true, predicted):
        for n, (frame, box) in enumerate(zip(rows.frame, rows.records, strict=True)):
            if np.isnan(xy[frame, 0]) and "ego_translation" in box:
                offset = read_numbers(box, "ego_translation", 3, rows.names[n])
                if offset.any():  # the devkit writes zeros where it is unknown
                    xy[frame] = rows.xy[n] - offset[:2]
    missing = np.flatnonzero(np.isnan(xy[:, 0]))
    if len(missing):
        raise InputError(
            f"{path}: frame {tokens[missing[0]]} does not tell where the ego vehicle is "
            "(ego_poses, or ego_translation of a box)"
        )
    return _Ego(xy, yaw)
