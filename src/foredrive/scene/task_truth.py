"""The ground truth of one example for the tasks beyond occupancy and planning."""

from dataclasses import dataclass

from foredrive.scene.affordances import Affordances
from foredrive.scene.agent_futures import AgentFutures
from foredrive.scene.map_elements import InstanceRaster, MapElements, MapRaster
from foredrive.scene.record import Record
from foredrive.scene.semantics import RayTruth, SemanticVoxels


@dataclass(frozen=True)
class TaskTruth(Record):
    """What heads learn and metrics judge by, beside the boxes of the clip. None was not asked for."""

    futures: AgentFutures | None = None
    elements: MapElements | None = None
    raster: MapRaster | None = None
    semantics: SemanticVoxels | None = None
    instances: InstanceRaster | None = None
    rays: RayTruth | None = None
    affordances: Affordances | None = None
