"""Metrics: pure functions of predictions and truth, summed up by `foredrive.evaluation`."""

from foredrive.metrics.forecasts import FuturesCounts, count_futures, ego_compensated
from foredrive.metrics.images import psnr_db, ssim
from foredrive.metrics.obstacles import Obstacles, boxes_at_now, future_obstacles
from foredrive.metrics.occupancy import (
    FlowErrors,
    OccupancyCounts,
    OccupancyPrior,
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
    "OccupancyPrior",
    "PlanScores",
    "PlanningProtocol",
    "above_ground",
    "boxes_at_now",
    "count_futures",
    "count_occupancy",
    "ego_compensated",
    "flow_errors",
    "future_obstacles",
    "psnr_db",
    "score_plan",
    "ssim",
]
