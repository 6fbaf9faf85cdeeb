"""The metrics of an evaluation, one file each. A new metric is a file here and a line in `METRICS`."""

from foredrive.tasks.detection.detection_metric import DetectionMetric
from foredrive.tasks.maps.map_lines_metric import MapLinesMetric
from foredrive.tasks.maps.map_raster_metric import MapRasterMetric
from foredrive.tasks.metric import MetricFactory
from foredrive.tasks.motion.motion_metric import MotionMetric
from foredrive.tasks.occupancy.flow_metric import FlowMetric
from foredrive.tasks.occupancy.futures_metric import FuturesMetric
from foredrive.tasks.occupancy.instances_metric import InstanceMetric
from foredrive.tasks.occupancy.occupancy_metric import OccupancyMetric
from foredrive.tasks.occupancy.semantics_metric import SemanticVoxelMetric
from foredrive.tasks.occupancy.vehicles_metric import VehicleMetric
from foredrive.tasks.planning.planning_metric import PlanningMetric
from foredrive.tasks.rendering.image_metric import ImageMetric
from foredrive.tasks.tracking.tracking_metric import TrackingMetric

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
