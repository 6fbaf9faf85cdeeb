"""Open-loop planning protocols, occupancy, image quality: pure functions."""

from foredrive.metrics.forecasts import FuturesCounts, carried_along, count_futures
from foredrive.metrics.images import psnr_db, ssim
from foredrive.metrics.obstacles import Obstacles, boxes_at_now, future_obstacles
from foredrive.metrics.occupancy import (
    FlowErrors,
    OccupancyCounts,
    VoxelPrior,
    above_ground,
    count_occupancy,
    flow_errors,
)
from foredrive.metrics.planning import PlanScores, score_plan
from foredrive.metrics.protocols import PROTOCOLS, ObstacleGrid, PlanningProtocol

__all__ = [
    "PROTOCOLS",
    "FlowErrors",
    "FuturesCounts",
    "ObstacleGrid",
    "Obstacles",
    "OccupancyCounts",
    "PlanScores",
    "PlanningProtocol",
    "VoxelPrior",
    "above_ground",
    "boxes_at_now",
    "carried_along",
    "count_futures",
    "count_occupancy",
    "flow_errors",
    "future_obstacles",
    "psnr_db",
    "score_plan",
    "ssim",
]
