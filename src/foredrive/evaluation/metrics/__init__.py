"""The metrics of an evaluation, one file each. A new metric is a file here and a line in `METRICS`."""

from foredrive.evaluation.metric import MetricFactory
from foredrive.evaluation.metrics.detection import DetectionMetric
from foredrive.evaluation.metrics.flow import FlowMetric
from foredrive.evaluation.metrics.futures import FuturesMetric
from foredrive.evaluation.metrics.images import ImageMetric
from foredrive.evaluation.metrics.instances import InstanceMetric
from foredrive.evaluation.metrics.maps import MapLinesMetric, MapRasterMetric
from foredrive.evaluation.metrics.motion import MotionMetric
from foredrive.evaluation.metrics.occupancy import OccupancyMetric
from foredrive.evaluation.metrics.planning import PlanningMetric
from foredrive.evaluation.metrics.semantics import SemanticVoxelMetric
from foredrive.evaluation.metrics.tracking import TrackingMetric
from foredrive.evaluation.metrics.vehicles import VehicleMetric

METRICS: tuple[MetricFactory, ...] = (
    OccupancyMetric,
    FuturesMetric,
    FlowMetric,
    VehicleMetric,
    ImageMetric,
    PlanningMetric,
    DetectionMetric,
    TrackingMetric,
    MotionMetric,
    MapRasterMetric,
    MapLinesMetric,
    SemanticVoxelMetric,
    InstanceMetric,
)
"""In the order of their figures in a summary."""
