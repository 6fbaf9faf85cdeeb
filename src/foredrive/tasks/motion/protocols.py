"""The protocols of end-to-end motion forecasting in use on nuScenes, as data.

All match detected agents with annotated ones, and then compare the best of K futures with what the agent
drove, in steps of 0.5 s. In everything else they differ, so that their numbers cannot be compared.

Facts read in the public code:
- UniAD: OpenDriveLab/UniAD, datasets/eval_utils/{nuscenes_eval_motion,eval_utils,metric_utils}.py,
  datasets/data_utils/data_utils.py (filter of results by the range of the detected class), and
  uniad/detectors/uniad_track.py (tracks with a score of at least 0.35 are written)
- SparseDrive: swc-17/SparseDrive, datasets/evaluation/motion/{motion_eval_uniad,motion_utils}.py; it is
  UniAD's with another score floor
- VAD: hustvl/VAD, VAD/VAD.py (`assign_pred_to_gt_vip3d`, `compute_motion_metric_vip3d`, after ViP3D) and the
  test pipeline of VAD_base_e2e.py, which keeps annotations of 30 × 60 m around the lidar

Two slips are not repeated: without any match UniAD reports an EPA of 0, however many false positives there
are (SparseDrive stops with an error); and it adds 1e-5 to the number of agents in EPA's denominator.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from foredrive.scene import Category
from foredrive.tasks.planning.protocols import LIDAR_FORWARD_M
from foredrive.tasks.planning.protocols import VEHICLES as VEHICLES_AND_CYCLES

STEP_S = 0.5
PEDESTRIANS = frozenset({Category.PEDESTRIAN})


@dataclass(frozen=True)
class Disc:
    """Agents within a range around the ego vehicle, by class."""

    range_m: Mapping[str, float]


@dataclass(frozen=True)
class Rectangle:
    """Agents within a rectangle around a point ahead of the rear axle."""

    true_half_xy_m: tuple[float, float]
    predicted_half_xy_m: tuple[float, float]
    forward_m: float


@dataclass(frozen=True)
class MotionProtocol:
    """The choices that define a protocol of end-to-end motion forecasting."""

    title: str
    steps: int
    """Steps of 0.5 s that are judged."""
    classes: Mapping[str, frozenset[Category]]
    ignored: frozenset[Category]
    """Categories that may be matched across classes but belong to no class themselves."""
    min_score: float
    """Predictions with a lower score are dropped …"""
    min_score_kept: bool
    """… and those of exactly this score too, if False."""
    region: Disc | Rectangle
    matching: Literal["score", "distance"]
    """"score": in each class, the best scored first takes the nearest agent that is left, nearer than 2 m.
    "distance": as many pairs of at most 2 m as possible, the nearest, and across classes."""
    errors: Literal["over_recall", "mean"]
    """"over_recall": as nuScenes' TP errors. The running mean in order of the score is resampled over recall
    and averaged from recall 0.11 to the largest reached; 1 if that is below. "mean": over all pairs."""
    miss: Literal["any_step", "last_step"]
    """In every future, any step is more than 2 m off; or the last step, of agents with their whole future."""
    incomplete: Literal["counted", "partly"]
    """"counted": agents are judged over the steps that are known; without any, all errors are 0 and count.
    "partly": without any they are skipped, and FDE and misses need the whole future."""
    epa: Literal["rematched", "matched"]
    """Hits of EPA. "rematched": of a second matching that asks for an FDE below 2 m as well, over all agents.
    "matched": of the same matching, FDE at most 2 m, over agents with their whole future."""


MATCH_M = 2.0
"""Distance now within which a detection belongs to an agent, in every protocol here."""
MISS_M = 2.0
"""Distance of a miss, in every protocol here."""
FALSE_POSITIVE_COST = 0.5
"""Share of a hit that a false positive costs in EPA (Gu et al., ViP3D, CVPR 2023, eq. 9)."""

_UNIAD = MotionProtocol(
    title="UniAD",
    steps=12,
    classes={"car": VEHICLES_AND_CYCLES, "pedestrian": PEDESTRIANS},
    ignored=frozenset(),
    min_score=0.35,
    min_score_kept=True,
    region=Disc({"car": 50.0, "pedestrian": 40.0}),  # of the merged class: cyclists up to 50 m
    matching="score",
    errors="over_recall",
    miss="any_step",
    incomplete="counted",
    epa="rematched",
)

PROTOCOLS: dict[str, MotionProtocol] = {
    "uniad": _UNIAD,
    "sparsedrive": MotionProtocol(**{**vars(_UNIAD), "title": "SparseDrive", "min_score": 0.2}),
    "vad": MotionProtocol(
        title="VAD",
        steps=6,
        classes={
            "car": frozenset({Category.CAR, Category.TRUCK, Category.BUS, Category.TRAILER}),
            "pedestrian": PEDESTRIANS,
        },
        ignored=frozenset({Category.MOTORCYCLE, Category.BICYCLE}),
        min_score=0.6,
        min_score_kept=False,
        region=Rectangle((30.0, 15.0), (35.0, 20.0), LIDAR_FORWARD_M),
        matching="distance",
        errors="mean",
        miss="last_step",
        incomplete="partly",
        epa="matched",
    ),
}
