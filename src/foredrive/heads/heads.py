"""All heads in parallel on one plane module; each can be left out (PARA-Drive, Weng et al. 2024)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Float64
from torch import Tensor, nn

from foredrive.heads.agents_head import AgentHead, AgentHeadConfig, AgentSet
from foredrive.heads.carried import (
    CarriedAgents,
    FrameSteps,
    Lineage,
    follow,
    frame_steps,
    lineage_of,
)
from foredrive.heads.instances_head import InstanceHead, InstanceHeadConfig, InstanceSet
from foredrive.heads.map_head import MapHead, MapHeadConfig, MapSet, RasterHead, RasterHeadConfig
from foredrive.heads.plane import Plane, PlanePyramid, Planes
from foredrive.heads.proposals import CentreMap
from foredrive.scene import Belief, Task, VoxelSpec, WorldModel
from foredrive.scene.map_elements import PlaneSpec
from foredrive.scene.record import Record
from foredrive.scene.semantics import VOXEL_CLASSES, Taxonomy


@dataclass(frozen=True)
class VoxelHeadConfig:
    """Sizes of a `VoxelHead`."""

    taxonomy: Taxonomy = "occ3d"
    hidden: int = 32


class VoxelHead(nn.Module):
    """An MLP from the features of a voxel and of its column to the logits of the voxel's classes.

    The column's features come from the fine plane and become one vector for each height (FlashOcc, Yu et al.
    2023).

    Args:
        planes: the module that makes the planes.
        channels: D of the volume.
        height: Z of the volume.
        config: sizes.
    """

    def __init__(self, planes: PlanePyramid, channels: int, height: int, config: VoxelHeadConfig) -> None:
        super().__init__()
        self.taxonomy = config.taxonomy
        self.height = height
        self.own = nn.Conv3d(channels, config.hidden, 1)
        self.column = nn.Conv2d(planes.fine_width, height * config.hidden, 1)
        self.out = nn.Conv3d(config.hidden, len(VOXEL_CLASSES[config.taxonomy]), 1)

    def forward(self, volume: Float[Tensor, "b D Z Y X"], planes: Planes) -> Float[Tensor, "b C Z Y X"]:
        """Return the logits in the order of `VOXEL_CLASSES`."""
        # One vector of the column for each height, added to the features of each voxel
        around = self.column(planes.fine.features).unflatten(1, (-1, self.height))
        logits: Tensor = self.out((self.own(volume) + around).relu())
        return logits


@dataclass(frozen=True)
class TaskHeadsConfig:
    """Sizes of the heads. A head that is None is left out. The defaults are for towns on two cores."""

    width: int = 64
    max_cells: int = 32
    """Maximum number of cells along a side of the coarse plane, to which all queries attend."""
    past: bool = True
    """Read the volume of one key frame earlier too, where the world model keeps it."""
    agents: AgentHeadConfig | None = field(default_factory=AgentHeadConfig)
    elements: MapHeadConfig | None = field(default_factory=MapHeadConfig)
    raster: RasterHeadConfig | None = field(default_factory=RasterHeadConfig)
    voxels: VoxelHeadConfig | None = field(default_factory=VoxelHeadConfig)
    instances: InstanceHeadConfig | None = None
    """Needs agents, and beliefs that the world model imagines."""
    volume_of: Task | None = None
    """Task whose volume all heads read. None: each head reads that of its own task. A frozen world model has
    learned no prompt but that of occupancy for the present, so probes read this one."""

    @property
    def of_agents(self) -> Task:
        """Return the task of the head of agents: tracking if it carries them from frame to frame."""
        carried = None if self.agents is None else self.agents.carried
        return "detection" if carried is None else carried.task

    @property
    def tasks(self) -> tuple[Task, ...]:
        """Return the tasks of the heads."""
        tasks: list[Task] = []
        if self.agents is not None:
            tasks += [self.of_agents] if self.agents.motion is None else [self.of_agents, "motion"]
        if self.elements is not None or self.raster is not None:
            tasks.append("map")
        if self.voxels is not None:
            tasks.append("occupancy")
        return tuple(tasks)

    def read_for(self, task: Task) -> Task:
        """Return the task whose volume the head of a task reads."""
        return self.volume_of or task

    @property
    def volumes(self) -> tuple[Task, ...]:
        """Return the tasks whose volumes the heads read."""
        return tuple(dict.fromkeys(self.read_for(task) for task in self.tasks))

    @property
    def frames(self) -> int:
        """Return the number of key frames of a training sequence; 1 if no agents are carried on."""
        return 1 if self.agents is None or self.agents.carried is None else self.agents.carried.frames

    def steps(self, T_world_ego: Float64[Tensor, "b 4 4"]) -> FrameSteps | None:
        """Return the ego motion of a batch of training sequences; None if no agents are carried on.

        Args:
            T_world_ego: pose at the now of each item.
        """
        if self.agents is None or self.agents.carried is None:
            return None
        return frame_steps(T_world_ego, self.agents.carried.frames, self.agents.carried.dt_s)

    @property
    def later(self) -> int:
        """Return the number of imagined key frames that the heads read."""
        return 0 if self.instances is None else self.instances.steps


@dataclass(frozen=True)
class TaskVolume(Record):
    """The volume that the heads of a task read, and an earlier one where the world model keeps it."""

    now: Float[Tensor, "b D Z Y X"]
    past: Float[Tensor, "b D Z Y X"] | None = None
    """In its own ego frame."""
    T_past_now: Float[Tensor, "b 4 4"] | None = None
    """The ego frame at now -> the ego frame of the past volume."""
    later: Float[Tensor, "b K D Z Y X"] | None = None
    """Volumes of K imagined key frames, each in its own ego frame, for heads that read them."""
    T_now_later: Float[Tensor, "b K 4 4"] | None = None
    """The ego frames of these -> the ego frame at now."""


def volumes_of(
    world: WorldModel, belief: Belief, tasks: Sequence[Task], later: int = 0
) -> dict[Task, TaskVolume]:
    """Return what the heads of some tasks read of a belief about now. Equal volumes are the same record.

    Args:
        world: the world model.
        belief: about now.
        tasks: tasks of the heads.
        later: number of key frames to imagine, or as many as the world model can.
    """
    # Imagining is costly and runs only for heads that read it
    imagined, T_now_later = imagined_volumes(world, belief, later) if later else (None, None)
    past = None if belief.T_past_now is None or belief.history is None else belief.history[:, -2]
    shared_volumes: dict[int, TaskVolume] = {}
    by_task: dict[Task, TaskVolume] = {}
    for task in tasks:
        volume = world.volume_for(belief, task)
        # Tasks with the same volume share one record, and with it the planes made of it
        by_task[task] = shared_volumes.setdefault(
            id(volume),
            TaskVolume(volume, past, belief.T_past_now, imagined, T_now_later),
        )
    return by_task


def imagined_volumes(
    world: WorldModel, belief: Belief, steps: int
) -> tuple[Float[Tensor, "b K D Z Y X"], Float[Tensor, "b K 4 4"]]:
    """Return the volumes of the next `steps` key frames, as occupancy reads them, and their ego motion.

    There are fewer if the world model imagines fewer.
    """
    beliefs = world.imagine(belief, steps if world.max_steps is None else min(steps, world.max_steps))
    eye = torch.eye(4, device=belief.volume.device).expand(len(belief.volume), 4, 4)
    poses = [eye if later.T_now_ego is None else later.T_now_ego for later in beliefs]
    volumes = [world.volume_for(later, "occupancy") for later in beliefs]
    return torch.stack(volumes, dim=1), torch.stack(poses, dim=1)


@dataclass(frozen=True)
class HeadOutput:
    """The output of the heads. Lists hold one entry for each decoder layer, the last is the result."""

    agents: list[AgentSet] | None = None
    centres: CentreMap | None = None
    """The dense map that the agents' queries begin from."""
    elements: list[MapSet] | None = None
    raster: Float[Tensor, "b L _H _W"] | None = None
    """Logits."""
    voxels: Float[Tensor, "b C Z Y X"] | None = None
    """Logits."""
    lineage: Lineage | None = None
    """Origin of each agent in the frame before. Only heads that carry agents have it."""
    instances: InstanceSet | None = None
    """Occupancy of single vehicles, now and later; of sequences, that of the last frame of each."""


class TaskHeads(nn.Module):
    """Heads on the volumes of a world model.

    Args:
        config: sizes.
        spec: grid of the volumes.
        channels: D of the volumes.
        raster: grid of the map's raster layers. Needed for this head only.
        instance_grid: grid of instances. Needed for their prediction only.
    """

    def __init__(
        self,
        config: TaskHeadsConfig,
        spec: VoxelSpec,
        *,
        channels: int,
        raster: PlaneSpec | None = None,
        instance_grid: PlaneSpec | None = None,
    ) -> None:
        super().__init__()
        self.config = config
        self.planes = planes = PlanePyramid(
            spec, channels=channels, width=config.width, max_cells=config.max_cells, past=config.past
        )
        self.agents = None if config.agents is None else AgentHead(planes, config.agents)
        self.elements = None if config.elements is None else MapHead(planes, config.elements)
        self.instances = None if config.instances is None else InstanceHead(planes, config.instances)
        self.instance_grid = instance_grid
        self.raster: RasterHead | None = None
        if config.raster is not None:
            assert raster is not None, "a raster head needs its grid"
            self.raster = RasterHead(planes, raster, config.raster)
        self.voxels: VoxelHead | None = None
        if config.voxels is not None:
            self.voxels = VoxelHead(planes, channels, spec.shape_zyx[0], config.voxels)

    def forward(
        self,
        volumes: Mapping[Task, TaskVolume],
        steps: FrameSteps | None = None,
        carried: CarriedAgents | None = None,
    ) -> HeadOutput:
        """Return the output of every head. Tasks that share one volume share its planes.

        Args:
            volumes: for each of `config.volumes`, the volume of `WorldModel.volume_for`. Without imagined
                ones, there are no instances.
            steps: ego motion, if the items are sequences of frames, in which agents are carried on.
            carried: agents of the frame before, for items that are single frames.
        """
        made: dict[int, Planes] = {}

        def volume_of(task: Task) -> TaskVolume:
            return volumes[self.config.read_for(task)]

        def planes_of(task: Task) -> Planes:
            volume = volume_of(task)
            # Planes are made once for each distinct volume
            if id(volume) not in made:
                made[id(volume)] = self.planes(volume.now, volume.past, volume.T_past_now)
            return made[id(volume)]

        of_agents = self.config.of_agents
        agents = centres = elements = raster = voxels = lineage = None
        if self.agents is not None:
            motion = None if self.agents.motion is None else planes_of("motion")
            centres, agents, lineage = self._follow(self.agents, planes_of(of_agents), motion, steps, carried)
        if self.elements is not None:
            elements = self.elements(planes_of("map"))
        if self.raster is not None:
            raster = self.raster(planes_of("map"))
        if self.voxels is not None:
            voxels = self.voxels(volume_of("occupancy").now, planes_of("occupancy"))
        instances = None
        if self.instances is not None and agents is not None and volume_of(of_agents).later is not None:
            # Imagined volumes are read for the last frame of a sequence only
            last = _last_frames(steps)
            instances = self._imagined(
                self.instances,
                agents[-1][last],
                volume_of(of_agents)[last],
                planes_of(of_agents).fine[last],
            )
        return HeadOutput(agents, centres, elements, raster, voxels, lineage, instances)

    def _imagined(self, head: InstanceHead, agents: AgentSet, volume: TaskVolume, now: Plane) -> InstanceSet:
        """Return the instances on the planes of the imagined volumes; each has the one before as its past."""
        assert agents.query is not None
        assert volume.later is not None, "instances need imagined volumes"
        assert volume.T_now_later is not None
        later, before = [], volume.now
        T_now_before = torch.eye(4, device=before.device).expand(len(before), 4, 4)
        for imagined, T_now in zip(volume.later.unbind(1), volume.T_now_later.unbind(1), strict=True):
            # Motion from the imagined frame to the frame before it
            T_before_now = torch.linalg.inv(T_now_before.to(T_now)) @ T_now
            later.append(self.planes(imagined, before, T_before_now).fine)
            before, T_now_before = imagined, T_now
        return head(agents.query, now, later, volume.T_now_later)

    def _follow(
        self,
        head: AgentHead,
        planes: Planes,
        motion: Planes | None,
        steps: FrameSteps | None,
        carried: CarriedAgents | None,
    ) -> tuple[CentreMap, list[AgentSet], Lineage | None]:
        """Return the agents of all items, and their lineage if the head carries agents on."""
        config = None if self.config.agents is None else self.config.agents.carried
        if config is not None and steps is not None:
            return follow(head, config, planes, motion, steps)
        centres, agents = head(planes, motion, None if carried is None else carried.agents)
        return centres, agents, None if config is None else lineage_of(agents[-1], carried, config.decay)


def _last_frames(steps: FrameSteps | None) -> slice:
    """Return the items that are the last frame of a sequence; all items if they are single frames.

    The imagined volumes of one frame cost four times its planes, and those of the next frame show the same
    vehicles.
    """
    frames = 1 if steps is None else steps.T_now_before.shape[1]
    return slice(frames - 1, None, frames)
