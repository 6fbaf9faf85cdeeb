"""The open-loop planning protocols in use on nuScenes, as data.

All five score six steps of 0.5 s against the driven path and the annotated boxes, put the same vehicle on
the plan, skip a step in the numerator where the *driven* vehicle overlaps a box itself, and keep that step
in the denominator. In everything else they differ, so that their numbers cannot be compared.

Facts read in the public code:
- ST-P3: OpenDriveLab/ST-P3, evaluate.py, stp3/metrics.py, stp3/datas/NuscenesData.py
- UniAD: OpenDriveLab/UniAD, planning_head_plugin/planning_metrics.py, datasets/pipelines/occflow_label.py,
  datasets/data_utils/trajectory_api.py
- VAD: hustvl/VAD, VAD/planner/metric_stp3.py, VAD/VAD.py, tools/data_converter/vad_nuscenes_converter.py
- SparseDrive: swc-17/SparseDrive, datasets/evaluation/planning/planning_eval.py,
  datasets/nuscenes_3d_dataset.py
- BEV-Planner: NVlabs/BEV-Planner, planner_head/metric_stp3.py, planner_head/naive_planner.py,
  datasets/pipelines/loading.py

What public code takes from nuScenes alone is not asked for here: ST-P3 drops boxes of the lowest visibility,
SparseDrive and VAD those without a lidar or radar return, and `Boxes` knows neither. ST-P3 leaves out the
first two frames of a scene, which clips with two past frames do as well. Distances are taken between rear
axles; public code follows the lidar, which differs by up to 1 m times the difference in heading. Two slips
are not repeated: VAD's centre-point index is off by a quarter of the grid, and SparseDrive's "obj_col" counts
collisions of the driven vehicle (here a number of its own, under every protocol).
"""

from dataclasses import dataclass
from typing import Literal

from foredrive.scene import Category
from foredrive.scene.boxes import VEHICLES

STEPS = 6
STEP_S = 0.5
HORIZON_STEPS = (1, 3, 5)
"""Indices of the steps at 1, 2 and 3 s."""
HORIZON_NAMES = ("1s", "2s", "3s")

EGO_SIZE_LW_M = (4.084, 1.85)
LIDAR_FORWARD_M = 0.985793
"""Distance of nuScenes' lidar ahead of the rear axle; most of the protocols follow its path."""
EGO_CENTRE_FORWARD_M = 0.5
"""Distance of the vehicle's centre ahead of the followed point, in public code."""


@dataclass(frozen=True)
class ObstacleGrid:
    """A square grid around the ego vehicle, on which the plan's cells meet the boxes' cells."""

    cell_m: float
    reach_m: float
    """The grid covers ±`reach_m` forward and sideways; ego cells beyond it move to its border."""
    column_axis: Literal["left", "right"]
    """Direction in which columns count; rows count forward. It matters because positions are rounded down."""
    row_step: Literal["down", "up"]
    """How the plan's forward position is rounded to whole cells; sideways it is rounded down."""
    corner: Literal["nearest", "down"]
    """A box's corners go to the nearest grid line, or down to the cell centre before them."""


@dataclass(frozen=True)
class PlanningProtocol:
    """The choices that define an open-loop protocol."""

    title: str
    l2: Literal["at", "mean"]
    """Distance at the horizon, or the mean over the steps up to it."""
    collision: Literal["at", "mean", "any"]
    """Collision at the horizon's step, mean over the steps up to it, or whether any of these collides."""
    categories: frozenset[Category]
    known: Literal["anytime", "observed", "now"]
    """Boxes that count: all of a future step, or those of tracks annotated within the last second, or now."""
    grid: ObstacleGrid | None
    """None: exact polygons instead of cells."""
    heading: Literal["now", "step", "path"]
    """The ego box keeps its heading at now, turns along each step of at least 1 m, or along the path."""
    ego_size_lw_m: tuple[float, float]
    point_forward_m: float
    """The point whose path is followed, and the origin of boxes and grid, ahead of the rear axle."""
    centre_forward_m: float
    """Centre of the ego box ahead of that point."""
    frames: Literal["all", "complete"]
    """All frames, steps without a driven pose adding 0; or frames whose driven future is complete."""


PROTOCOLS: dict[str, PlanningProtocol] = {
    "stp3": PlanningProtocol(
        title="ST-P3",
        l2="mean",
        collision="mean",
        categories=VEHICLES | {Category.PEDESTRIAN},
        known="observed",
        grid=ObstacleGrid(cell_m=0.5, reach_m=50.0, column_axis="left", row_step="down", corner="nearest"),
        heading="now",
        ego_size_lw_m=EGO_SIZE_LW_M,
        point_forward_m=0.0,  # its boxes are relative to the rear axle: the ego box sits 1 m too far back
        centre_forward_m=EGO_CENTRE_FORWARD_M,
        frames="complete",
    ),
    "uniad": PlanningProtocol(
        title="UniAD",
        l2="at",
        collision="at",
        categories=VEHICLES,
        known="anytime",
        grid=ObstacleGrid(cell_m=0.5, reach_m=50.0, column_axis="right", row_step="down", corner="nearest"),
        heading="now",
        ego_size_lw_m=EGO_SIZE_LW_M,
        point_forward_m=LIDAR_FORWARD_M,
        centre_forward_m=EGO_CENTRE_FORWARD_M,
        frames="all",
    ),
    "vad": PlanningProtocol(
        title="VAD",
        l2="mean",
        collision="mean",
        categories=VEHICLES | {Category.PEDESTRIAN},
        known="now",
        grid=ObstacleGrid(cell_m=0.5, reach_m=50.0, column_axis="right", row_step="up", corner="nearest"),
        heading="now",
        ego_size_lw_m=EGO_SIZE_LW_M,
        point_forward_m=LIDAR_FORWARD_M,
        centre_forward_m=EGO_CENTRE_FORWARD_M,
        frames="complete",
    ),
    "sparsedrive": PlanningProtocol(
        title="SparseDrive",
        l2="mean",
        collision="mean",
        categories=frozenset(Category),
        known="anytime",
        grid=None,
        heading="path",
        ego_size_lw_m=EGO_SIZE_LW_M,
        point_forward_m=LIDAR_FORWARD_M,
        centre_forward_m=EGO_CENTRE_FORWARD_M,
        frames="complete",
    ),
    "bevplanner": PlanningProtocol(
        title="BEV-Planner",
        l2="mean",
        collision="any",
        categories=VEHICLES,
        known="anytime",
        grid=ObstacleGrid(cell_m=0.1, reach_m=50.0, column_axis="left", row_step="down", corner="down"),
        heading="step",
        ego_size_lw_m=EGO_SIZE_LW_M,
        point_forward_m=0.0,
        centre_forward_m=EGO_CENTRE_FORWARD_M + LIDAR_FORWARD_M,
        frames="complete",
    ),
}
