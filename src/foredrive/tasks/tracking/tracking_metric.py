"""Identities of detected road users over time, beside those of a simple tracker."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int64
from numpy import ndarray

from foredrive.scene import Example
from foredrive.tasks.files.frame_keys import continues, time_of
from foredrive.tasks.metric import EvaluationContext, Figures, Shown
from foredrive.tasks.objects.in_world import agent_rows, box_rows, likely, stacked
from foredrive.tasks.objects.object_rows import Frames, ObjectRows, Region
from foredrive.tasks.predictor import Part, Prediction
from foredrive.tasks.tracking.protocols import TRACKING_PROTOCOLS, evaluate_tracking
from foredrive.tasks.tracking.score import tracking_figures

MAX_AGE_FRAMES = 3
"""A track ends after so many frames without a detection."""
MAX_DISTANCE_M = {
    "car": 4.0,
    "truck": 4.0,
    "bus": 5.5,
    "trailer": 3.0,
    "pedestrian": 1.0,
    "motorcycle": 13.0,
    "bicycle": 3.0,
}
"""Maximum distance of a detection from a track, by class, for frames 0.5 s apart."""
FRAME_S = 0.5
CARS_30M = replace(
    TRACKING_PROTOCOLS["nuscenes"], title="cars within 30 m", region=Region("circle", {"car": (30.0, 30.0)})
)


@dataclass(frozen=True)
class _Tracks:
    """The tracks that may go on."""

    xy: Float[ndarray, "t 2"]
    """Last centre; moved on by the velocity while there is no detection."""
    velocity: Float[ndarray, "t 2"]
    label: Int64[ndarray, "t"]
    number: Int64[ndarray, "t"]
    age: Int64[ndarray, "t"]
    """Frames since the last detection."""


def greedy_tracks(predicted: ObjectRows, frames: Frames, classes: Sequence[str]) -> ObjectRows:
    """Return the detections of the classes with identities by greedy association at constant velocity.

    As in CenterPoint (Yin et al. 2021; tianweiy/CenterPoint, tools/nusc_tracking/pub_tracker.py): a detection
    is moved back by its velocity and takes the nearest track of its class that is left, within a distance of
    its class. Detections of high scores choose first; each that finds none begins a track. Every scene begins
    anew.

    Args:
        predicted: the frames of each row are indices into `frames`.
        frames: in the order of time within each scene.
        classes: names of the labels. Detections of other classes are left out.
    """
    # Classes without a limit are not tracked
    limit_m = np.array([MAX_DISTANCE_M.get(name, np.nan) for name in classes])
    predicted = predicted[(predicted.label >= 0) & np.isfinite(limit_m)[predicted.label]]
    number = np.full(len(predicted), -1, dtype=np.int64)
    tracks, begun = _nothing(), 0
    # Every scene begins anew
    for frame, dt_s in _steps(frames):
        tracks = _nothing() if dt_s is None else tracks
        rows = np.flatnonzero(predicted.frame == frame)
        # Detections of high scores choose first
        rows = rows[np.argsort(-predicted.score[rows], kind="stable")]
        here = predicted[rows]
        dt_s = dt_s or FRAME_S
        # Limits are for steps of 0.5 s and scale with the time step
        partner = _partners(here, tracks, limit_m * dt_s / FRAME_S, dt_s)
        # Detections without a track begin one
        new = partner < 0
        number[rows[~new]] = tracks.number[partner[~new]]
        number[rows[new]] = begun + np.arange(new.sum())
        begun += int(new.sum())
        tracks = _next_tracks(here, number[rows], tracks, partner, dt_s)
    return replace(predicted, track=number)


def _steps(frames: Frames) -> Iterator[tuple[int, float | None]]:
    """Yield each frame with the time since the one before it in its scene, s; None for the first."""
    for frame in range(len(frames)):
        first = frame == 0 or frames.scene[frame] != frames.scene[frame - 1]
        yield frame, None if first else 1e-6 * float(frames.time_us[frame] - frames.time_us[frame - 1])


def _partners(
    here: ObjectRows, tracks: _Tracks, limit_m: Float[ndarray, "c"], dt_s: float
) -> Int64[ndarray, "n"]:
    """Return the track of each detection; -1: none."""
    partner = np.full(len(here), -1, dtype=np.int64)
    if len(tracks.number) == 0:
        return partner
    # Move each detection back to the time of the frame before
    before = here.centre[:, :2] - np.nan_to_num(here.velocity) * dt_s
    away_m = np.linalg.norm(before[:, None] - tracks.xy, axis=-1)
    # Other classes, and tracks beyond the limit of the class
    away_m[(here.label[:, None] != tracks.label) | (away_m > limit_m[here.label][:, None])] = np.inf
    for row in range(len(here)):
        nearest = int(away_m[row].argmin())
        if np.isfinite(away_m[row, nearest]):
            partner[row] = nearest
            # A track is taken once
            away_m[:, nearest] = np.inf
    return partner


def _next_tracks(
    here: ObjectRows,
    number: Int64[ndarray, "n"],
    tracks: _Tracks,
    partner: Int64[ndarray, "n"],
    dt_s: float,
) -> _Tracks:
    # Tracks without a detection go on for a few frames, moved by their velocity
    left = np.setdiff1d(np.flatnonzero(tracks.age < MAX_AGE_FRAMES), partner)
    velocity = np.nan_to_num(here.velocity)
    return _Tracks(
        xy=np.concatenate([here.centre[:, :2], tracks.xy[left] + dt_s * tracks.velocity[left]]),
        velocity=np.concatenate([velocity, tracks.velocity[left]]),
        label=np.concatenate([here.label, tracks.label[left]]),
        number=np.concatenate([number, tracks.number[left]]),
        age=np.concatenate([np.ones(len(here), dtype=np.int64), tracks.age[left] + 1]),
    )


def _nothing() -> _Tracks:
    none, zero = np.zeros((0, 2)), np.zeros(0, dtype=np.int64)
    return _Tracks(none, none, zero, zero, zero)


CLASSES = TRACKING_PROTOCOLS["nuscenes"].classes
BASELINE = ".greedy_association"


class TrackingMetric:
    """Keys: `nuscenes.amota`, `nuscenes.ids`, `nuscenes.car.ids`, `uniad.amota`, `car_amota_30m`, ….

    The keys of the baseline end in `.greedy_association`: the same detections with the identities of
    `greedy_tracks`. A model whose agents have no identities has the baseline's figures alone. Frames without
    annotation do not count. A drive is cut where frames are missing, and each part is a scene of its own.
    """

    name = "tracking"
    title = "Tracking"
    shown: tuple[Shown, ...] = (
        Shown("AMOTA", "nuscenes.amota", "greedy_association"),
        Shown("AMOTA of cars within 30 m", "car_amota_30m", "greedy_association"),
        Shown("changed identities", "nuscenes.ids", "greedy_association"),
    )
    needs: frozenset[Part] = frozenset({"agents"})

    def __init__(self, context: EvaluationContext) -> None:
        self._found: list[ObjectRows] = []
        self._true: list[ObjectRows] = []
        self._scene: list[int] = []
        self._keys: list[str] = []

    def update(self, prediction: Prediction, truth: Example) -> None:
        """Add b clips, which follow those of the last call."""
        assert prediction.agents is not None
        clip = truth.clip
        for item in clip.boxes_valid[:, clip.now].nonzero()[:, 0].tolist():
            frame, key = len(self._keys), truth.key[item]
            pose = clip.T_world_ego[item, clip.now].cpu().numpy()
            self._found.append(agent_rows(likely(prediction.agents[item]), pose, frame, CLASSES))
            self._true.append(box_rows(clip.boxes[item, clip.now], pose, frame, CLASSES))
            # A missing frame of the drive starts a new scene
            scene = self._scene[-1] if self._scene else 0
            goes_on = not self._keys or continues(self._keys[-1], key)
            self._scene.append(scene if goes_on else scene + 1)
            self._keys.append(key)

    def result(self) -> Figures:
        """Return the figures over all annotated frames."""
        if not self._keys:
            return {"frames_counted": 0}
        predicted, true = stacked(self._found), stacked(self._true)
        times = np.array([time_of(key) for key in self._keys], dtype=np.int64)
        frames = Frames(np.array(self._scene, dtype=np.int64), times)
        out: Figures = {"frames_counted": len(frames), "scenes": self._scene[-1] + 1}
        if (predicted.track >= 0).any():
            # Identities of the model, if it has any
            out |= _figures(predicted[predicted.track >= 0], true, frames)
        # The baseline takes the same detections
        simple = _figures(greedy_tracks(predicted, frames, CLASSES), true, frames)
        return out | {f"{key}{BASELINE}": value for key, value in simple.items()}


def _figures(tracks: ObjectRows, true: ObjectRows, frames: Frames) -> Figures:
    """Return the figures of every protocol, and of the cars nearby."""
    cars = evaluate_tracking(tracks, true, true[:0], frames, CARS_30M).by_class["car"]
    near = {"car_amota_30m": cars["amota"], "car_ids_30m": cars["ids"]} if cars["gt"] > 0 else {}
    return tracking_figures(tracks, true, true[:0], frames) | near
