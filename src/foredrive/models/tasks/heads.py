"""All heads in parallel on one plane module; each can be left out (PARA-Drive, Weng et al. 2024)."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from jaxtyping import Float
from torch import Tensor, nn

from foredrive.models.tasks.agents import AgentHead, AgentHeadConfig, AgentSet
from foredrive.models.tasks.maps import MapHead, MapHeadConfig, MapSet, RasterHead, RasterHeadConfig
from foredrive.models.tasks.plane import Plane, PlaneFeatures, halvings
from foredrive.models.tasks.voxels import VoxelHead, VoxelHeadConfig
from foredrive.scene import Task, VoxelSpec
from foredrive.scene.map_elements import PlaneSpec


@dataclass(frozen=True)
class TaskHeadsConfig:
    """Sizes of the heads. A head that is None is left out. The defaults are for towns on two cores."""

    width: int = 64
    max_cells: int = 32
    """Maximum number of cells along a side of the plane, to which all queries attend."""
    agents: AgentHeadConfig | None = field(default_factory=AgentHeadConfig)
    elements: MapHeadConfig | None = field(default_factory=MapHeadConfig)
    raster: RasterHeadConfig | None = field(default_factory=RasterHeadConfig)
    voxels: VoxelHeadConfig | None = field(default_factory=VoxelHeadConfig)

    @property
    def tasks(self) -> tuple[Task, ...]:
        """Return the tasks whose volumes the heads read."""
        found: list[Task] = []
        if self.agents is not None:
            found += ["detection"] if self.agents.motion is None else ["detection", "motion"]
        if self.elements is not None or self.raster is not None:
            found.append("map")
        if self.voxels is not None:
            found.append("occupancy")
        return tuple(found)


@dataclass(frozen=True)
class HeadOutput:
    """The output of the heads. Lists hold one entry for each decoder layer, the last is the result."""

    agents: list[AgentSet] | None = None
    elements: list[MapSet] | None = None
    raster: Float[Tensor, "b L _H _W"] | None = None
    """Logits."""
    voxels: Float[Tensor, "b C Z Y X"] | None = None
    """Logits."""


class TaskHeads(nn.Module):
    """Heads on the volumes of a world model.

    Args:
        config: sizes.
        spec: grid of the volumes.
        channels: D of the volumes.
        raster: grid of the map's raster layers. Needed for this head only.
    """

    def __init__(
        self, config: TaskHeadsConfig, spec: VoxelSpec, *, channels: int, raster: PlaneSpec | None = None
    ) -> None:
        super().__init__()
        self.config = config
        shrink = halvings(spec, config.max_cells)
        self.plane = PlaneFeatures(spec, channels=channels, width=config.width, shrink=shrink)
        self.agents = None if config.agents is None else AgentHead(self.plane, config.agents)
        self.elements = None if config.elements is None else MapHead(self.plane, config.elements)
        self.raster: RasterHead | None = None
        if config.raster is not None:
            assert raster is not None, "a raster head needs its grid"
            self.raster = RasterHead(self.plane, raster, config.raster)
        self.voxels = None if config.voxels is None else VoxelHead(channels, config.voxels)

    def forward(self, volumes: Mapping[Task, Float[Tensor, "b D Z Y X"]]) -> HeadOutput:
        """Return the output of every head. Tasks that share one volume share its plane.

        Args:
            volumes: for each of `config.tasks`, the volume of `WorldModel.volume_for`.
        """
        planes: dict[int, Plane] = {}

        def plane_of(task: Task) -> Plane:
            volume = volumes[task]
            if id(volume) not in planes:
                planes[id(volume)] = self.plane(volume)
            return planes[id(volume)]

        agents = elements = raster = voxels = None
        if self.agents is not None:
            motion = None if self.agents.motion is None else plane_of("motion")
            agents = self.agents(plane_of("detection"), motion)
        if self.elements is not None:
            elements = self.elements(plane_of("map"))
        if self.raster is not None:
            raster = self.raster(plane_of("map"))
        if self.voxels is not None:
            voxels = self.voxels(volumes["occupancy"])
        return HeadOutput(agents, elements, raster, voxels)
