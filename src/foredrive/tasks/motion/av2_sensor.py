"""End-to-end forecasts on Argoverse 2's sensor logs.

The results are the dictionary that av2's evaluation takes, as JSON, since pickles are never read: by log and
time (ns) a list of agents with `name`, `current_translation_m`, `detection_score`, `prediction_m` [5, 6, 2]
at steps of 0.5 s, and `score` [5], in the city frame. The truth is a folder of sensor logs with
`annotations.feather` and `city_SE3_egovehicle.feather`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int64
from numpy import ndarray
from scipy.spatial.transform import Rotation

from foredrive.errors import InputError
from foredrive.tasks.files.arrow_tables import read_table
from foredrive.tasks.files.plain_files import read_number_rows, read_plain
from foredrive.tasks.motion.agents import PredictedAgents, TrueAgents
from foredrive.tasks.motion.argoverse import FUTURES, MEAN_SPEED_MPS, STEPS
from foredrive.tasks.motion.protocols import STEP_S

CLASSES = tuple(MEAN_SPEED_MPS)
SLACK_NS = 60_000_000
"""How far an annotation may be from a step of 0.5 s. Sweeps are 0.1 s apart."""
_POSE = ("tx_m", "ty_m", "tz_m", "qw", "qx", "qy", "qz")


@dataclass(frozen=True)
class SensorForecasts:
    """End-to-end forecasts and truth; categories are indices into `CLASSES`."""

    predicted: PredictedAgents
    true: TrueAgents
    frames: int


def has_sensor_logs(folder: Path) -> bool:
    """Return whether a folder holds sensor logs of Argoverse 2, or is one."""
    return folder.is_dir() and any(_annotations(folder))


def _annotations(folder: Path) -> list[Path]:
    return sorted([*folder.glob("annotations*.feather"), *folder.glob("*/annotations*.feather")])


def read_end_to_end(results: Path, truth: Path) -> SensorForecasts:
    """Read end-to-end forecasts, and the annotations of their logs at the same times.

    Raises:
        InputError: a file cannot be read, or an entry is wrong. The message names it.
    """
    content = read_plain(results)
    if not isinstance(content, dict) or not all(isinstance(frames, dict) for frames in content.values()):
        raise InputError(f"{results}: there must be frames by time (ns), by log")
    files = {path.parent.name: path for path in _annotations(truth)}
    # Frames of all logs are numbered in one sequence
    predicted, true, offset = [], [], 0
    for log, frames in content.items():
        if log not in files:
            raise InputError(f"{results}: log {log} is not in {truth}: of another split?")
        times = _times(frames, f"{results}: log {log}")
        annotated = _Log.read(files[log])
        unknown = np.setdiff1d(times, annotated.t_ns)
        if len(unknown):
            raise InputError(f"{results}: log {log} is not annotated at {unknown[0]} ns")
        ego_xy = annotated.ego_xy(times)
        true.append(annotated.agents(times, ego_xy, offset))
        predicted.append(_agents(frames, log, ego_xy, offset, results))
        offset += len(times)
    if not offset:
        raise InputError(f"{results}: holds no frames")
    return SensorForecasts(_joined(predicted), _joined(true), offset)


def _times(frames: Mapping[str, Any], where: str) -> Int64[ndarray, "F"]:
    for time, agents in frames.items():
        if not time.isdecimal() or not isinstance(agents, list):
            raise InputError(f"{where}: {time!r} is no time in ns with a list of agents")
    return np.array([int(time) for time in frames], dtype=np.int64)


def _agents(
    frames: Mapping[str, list[Any]], log: str, ego_xy: Float[ndarray, "F 2"], offset: int, path: Path
) -> PredictedAgents:
    records, names, frame = [], [], []
    for number, (time, agents) in enumerate(frames.items()):
        for n, agent in enumerate(agents):
            where = f"{path}: log {log}, {time} ns, agent {n}"
            if not isinstance(agent, dict) or agent.get("name") not in MEAN_SPEED_MPS:
                name = agent.get("name") if isinstance(agent, dict) else agent
                raise InputError(f"{where}: the class {name!r} is not one of Argoverse 2's")
            records.append(agent)
            names.append(where)
            frame.append(number)
    number_of = np.array(frame, dtype=np.int64)
    # Positions relative to the ego vehicle, along the axes of the city
    place = read_number_rows(records, "current_translation_m", 2, names) - ego_xy[number_of]
    score = read_number_rows(records, "detection_score", 1, names)[:, 0]
    wrong = np.flatnonzero((score < 0) | (score > 1))
    if len(wrong):
        raise InputError(f"{names[wrong[0]]}: the score {score[wrong[0]]:g} is not in [0, 1]")
    flat = [{"prediction_m": np.ravel(agent.get("prediction_m", ()))} for agent in records]
    futures = read_number_rows(flat, "prediction_m", FUTURES * STEPS * 2, names)
    return PredictedAgents(
        number_of + offset,
        np.array([CLASSES.index(agent["name"]) for agent in records], dtype=np.int64),
        score,
        place,
        futures.reshape(-1, FUTURES, STEPS, 2) - ego_xy[number_of][:, None, None],
        read_number_rows(records, "score", FUTURES, names),
    )


@dataclass(frozen=True)
class _Log:
    """The annotated boxes of a log, in the city frame."""

    t_ns: Int64[ndarray, "n"]
    track: ndarray
    category: Int64[ndarray, "n"]
    """Index into `CLASSES`; -1 for a class that is not judged."""
    xy: Float[ndarray, "n 2"]
    pose_t_ns: Int64[ndarray, "P"]
    pose_xy: Float[ndarray, "P 2"]

    @classmethod
    def read(cls, annotations: Path) -> "_Log":
        boxes = read_table(annotations, ("timestamp_ns", "track_uuid", "category", *_POSE[:3]))
        path = annotations.parent / "city_SE3_egovehicle.feather"
        poses = read_table(path, ("timestamp_ns", *_POSE))
        t_ns, pose_t_ns = boxes["timestamp_ns"].to_numpy(), poses["timestamp_ns"].to_numpy()
        # Every annotation needs the pose at exactly its time
        row = np.searchsorted(pose_t_ns, t_ns).clip(0, len(pose_t_ns) - 1)
        if (pose_t_ns[row] != t_ns).any():
            raise InputError(f"{path}: has no pose at {t_ns[pose_t_ns[row] != t_ns][0]} ns")
        pose = np.stack([poses[name].to_numpy() for name in _POSE], axis=-1)
        centre = np.stack([boxes[name].to_numpy() for name in _POSE[:3]], axis=-1)
        # Boxes are stored in the ego frame of their time: move them to the city frame
        in_city = Rotation.from_quat(pose[row, 3:], scalar_first=True).apply(centre) + pose[row, :3]
        label = {name: n for n, name in enumerate(CLASSES)}
        return cls(
            t_ns,
            boxes["track_uuid"].to_numpy(zero_copy_only=False),
            np.array([label.get(name, -1) for name in boxes["category"].to_pylist()], dtype=np.int64),
            in_city[:, :2],
            pose_t_ns,
            pose[:, :2],
        )

    def ego_xy(self, times: Int64[ndarray, "F"]) -> Float[ndarray, "F 2"]:
        return self.pose_xy[np.searchsorted(self.pose_t_ns, times)]

    def agents(self, times: Int64[ndarray, "F"], ego_xy: Float[ndarray, "F 2"], offset: int) -> TrueAgents:
        """Return the boxes at some times, and where they are every 0.5 s after."""
        annotated = np.unique(self.t_ns)
        # Position of each track at each annotated time
        place = {(t, track): xy for t, track, xy in zip(self.t_ns.tolist(), self.track, self.xy, strict=True)}
        number = {t: n for n, t in enumerate(times.tolist())}
        rows = np.flatnonzero(np.isin(self.t_ns, times) & (self.category >= 0))
        frame = np.array([number[t] for t in self.t_ns[rows].tolist()], dtype=np.int64)
        future_xy = np.zeros((len(rows), STEPS, 2))
        valid = np.zeros((len(rows), STEPS), dtype=bool)
        for step in range(STEPS):
            wanted = self.t_ns[rows] + round((step + 1) * STEP_S * 1e9)
            # First annotated time that is not before the tolerance, and the one after it
            after = np.searchsorted(annotated, wanted - SLACK_NS).clip(0, len(annotated) - 2)
            pair = annotated[after[:, None] + np.arange(2)]
            nearest = np.take_along_axis(pair, np.abs(pair - wanted[:, None]).argmin(1)[:, None], 1)[:, 0]
            # A step without annotation within the tolerance stays unknown
            for n in np.flatnonzero(np.abs(nearest - wanted) <= SLACK_NS):
                xy = place.get((int(nearest[n]), self.track[rows[n]]))
                if xy is not None:
                    future_xy[n, step], valid[n, step] = xy - ego_xy[frame[n]], True
        return TrueAgents(
            frame + offset,
            self.category[rows],
            self.xy[rows] - ego_xy[frame],
            future_xy,
            valid,
            np.ones(len(rows), dtype=bool),
        )


def _joined(parts: Sequence[Any]) -> Any:
    return type(parts[0])(
        **{name: np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])}
    )
