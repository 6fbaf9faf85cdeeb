"""The table of agents that can drive, by the names that the command line accepts.

The modules of an agent are imported when it is built, so that the table can be read at once.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from foredrive.errors import InputError
from foredrive.runs.drive import remote_agents

if TYPE_CHECKING:
    from foredrive.scene import Agent
    from foredrive.towns.driving.town import TownSimulator

CRUISE_MPS = 5.0
EXPERT, DISTURBED, IDM = "expert", "disturbed", "idm"
STOP, CONSTANT_VELOCITY, GO_STRAIGHT = "stop", "constant-velocity", "go-straight"
BASELINES = (STOP, CONSTANT_VELOCITY, GO_STRAIGHT)
"""The agents beside which every other should be seen."""
REPLAY, CORRIDOR = "log", "lidar-corridor"
NEEDS_TOWN = "the expert and idm read the state of an embedded town and can drive only there"


Sees = Literal["camera", "lidar", "both"]
"""Sensors that an agent is shown."""


@dataclass(frozen=True)
class AgentSetup:
    """All that an agent of one drive is built from."""

    agent: str
    """Its whole name."""
    argument: str
    """The part of the name behind that of the kind: a run or an address."""
    clock: Callable[[], float]
    """Returns the time of the drive, s."""
    town: "TownSimulator | None"
    """None: the drive is not in an embedded town."""
    seed: int
    sees: Sees | None

    @property
    def folder(self) -> Path:
        """The folder of the run."""
        return agent_folder(self.agent, self.argument)

    def in_town(self) -> "TownSimulator":
        """Return the town.

        Raises:
            InputError: the drive is not in a town.
        """
        if self.town is None:
            raise InputError(NEEDS_TOWN)
        return self.town


def _build_expert(setup: AgentSetup) -> "Agent":
    from foredrive.towns.driving.town_expert import TownExpert

    return TownExpert(setup.in_town())


def _build_idm(setup: AgentSetup) -> "Agent":
    from foredrive.towns.driving.idm_agent import IdmAgent, TruePerception

    truth = TruePerception(setup.in_town())
    return IdmAgent(truth.path, truth.view)


def _straight_on(speed_mps: float, *, keeps: bool = False) -> Callable[[AgentSetup], "Agent"]:
    def build(setup: AgentSetup) -> "Agent":
        from foredrive.driving.simple_agents import StraightAgent

        return StraightAgent(speed_mps, keeps)

    return build


def _build_ego_mlp(setup: AgentSetup) -> "Agent":
    from foredrive.driving.restarts import RestartingAgent
    from foredrive.runs.drive.seeing_agents import fitted_mlp

    return RestartingAgent(fitted_mlp(setup.folder), setup.clock)


def _build_disturbed(setup: AgentSetup) -> "Agent":
    from foredrive.towns.driving.demonstrations import DisturbedExpert
    from foredrive.towns.driving.town_expert import TownExpert

    return DisturbedExpert(TownExpert(setup.in_town()), setup.clock, setup.seed)


def _build_student(setup: AgentSetup) -> "Agent":
    from foredrive.driver.agent import SightDriver
    from foredrive.runs.drive.seeing_agents import driver_of, following, seeing_agent
    from foredrive.runs.train.driver import is_driver
    from foredrive.towns.driving.demonstrations import AlternatingStudent
    from foredrive.towns.driving.town_expert import TownExpert

    folder = setup.folder
    seeing = (
        SightDriver(driver_of(folder)) if is_driver(folder) else following(seeing_agent(folder), setup.clock)
    )
    return AlternatingStudent(seeing, TownExpert(setup.in_town()), setup.clock, setup.seed)


def _build_run(setup: AgentSetup) -> "Agent":
    from foredrive.driver.agent import SightDriver
    from foredrive.driving.restarts import RestartingAgent
    from foredrive.runs.drive.seeing_agents import driver_of, following, seeing_agent
    from foredrive.runs.train.driver import is_driver

    folder = setup.folder
    if is_driver(folder):
        return SightDriver(driver_of(folder))
    return RestartingAgent(
        following(seeing_agent(folder), setup.clock), setup.clock, seeing_agent(folder).is_free
    )


def _build_rules_by_sight(setup: AgentSetup) -> "Agent":
    from foredrive.driver.agent import Perception, given_path
    from foredrive.runs.drive.seeing_agents import driver_of
    from foredrive.towns.driving.idm_agent import IdmAgent, TruePerception, estimated_view

    perceive = Perception(driver_of(setup.folder))
    # Without a town, the route is as far known as the observation tells it
    path = given_path if setup.town is None else TruePerception(setup.town).path
    return IdmAgent(path, lambda observation, _: estimated_view(perceive(observation)[0]))


def _partly_true(*, lights: bool, users: bool) -> Callable[[AgentSetup], "Agent"]:
    def build(setup: AgentSetup) -> "Agent":
        from foredrive.driver.agent import PartlyTrue, Perception, SightDriver
        from foredrive.runs.drive.seeing_agents import driver_of
        from foredrive.towns.driving.idm_agent import TruePerception

        driver, truth = driver_of(setup.folder), TruePerception(setup.in_town())
        return SightDriver(driver, PartlyTrue(Perception(driver), truth, lights=lights, users=users))

    return build


def _build_of_log(setup: AgentSetup) -> "Agent":
    check_without_log(setup.agent)
    raise AssertionError("`in_reconstruction` builds the agents that follow a log")


def _build_own(setup: AgentSetup) -> "Agent":
    from foredrive.integrations.own_agents import own_agent

    return own_agent(setup.agent)


@dataclass(frozen=True)
class AgentKind:
    """A row of the table of agents."""

    name: str
    """The agent's name. If it ends in ":" or "/", an argument follows it."""
    knows: str
    """A line of help: the agent, and the facts that it is told."""
    build: Callable[[AgentSetup], "Agent"]
    """Builds the agent of one drive."""
    argument: str = ""
    """Word for the argument in help."""
    sensors: Literal["none", "lidar", "remote", "trained", "ego", "declared"] = "none"
    """Sensors that it is shown: none, lidar, what another process asks for, the cameras of its run, the key
    frames of its run without images, or what its class declares."""
    of_driver: bool = False
    """Tells whether its run must be that of a driver."""
    of_log: bool = False
    """Tells whether it drives only in a reconstruction, along the path of the log."""
    ready: Callable[[str], None] | None = None
    """Waits until an agent in another process is alive; raises `InputError` if it is not."""


AGENTS: tuple[AgentKind, ...] = (
    AgentKind(EXPERT, "reads the town's state and its traffic's plans", _build_expert),
    AgentKind(
        IDM,
        "follows the route by the intelligent driver model, with true lights and road users",
        _build_idm,
    ),
    AgentKind(STOP, "never starts", _straight_on(0.0)),
    AgentKind(CONSTANT_VELOCITY, "straight on at 5 m/s", _straight_on(CRUISE_MPS)),
    AgentKind(
        GO_STRAIGHT,
        "straight on at the speed that it has, at least 5 m/s",
        _straight_on(CRUISE_MPS, keeps=True),
    ),
    AgentKind(DISTURBED, "the expert under disturbances, for demonstrations", _build_disturbed),
    AgentKind(REPLAY, "in a reconstruction: repeats the logged drive", _build_of_log, of_log=True),
    AgentKind(
        CORRIDOR,
        "in a reconstruction: follows the logged path and stops if lidar sees something in its corridor",
        _build_of_log,
        sensors="lidar",
        of_log=True,
    ),
    AgentKind(
        "ego-mlp:",
        "the MLP that sees only the ego status, fitted to the training data of the run",
        _build_ego_mlp,
        "RUN",
        "ego",
    ),
    AgentKind(
        "student:", "a run in alternation with the expert, for DAgger", _build_student, "RUN", "trained"
    ),
    AgentKind(
        "idm:",
        "idm with the perception of a driver's run",
        _build_rules_by_sight,
        "RUN",
        "trained",
        of_driver=True,
    ),
    AgentKind(
        "true:",
        "a driver with true lights and road users",
        _partly_true(lights=True, users=True),
        "RUN",
        "ego",
        of_driver=True,
    ),
    AgentKind(
        "true-lights:",
        "a driver with true lights",
        _partly_true(lights=True, users=False),
        "RUN",
        "trained",
        of_driver=True,
    ),
    AgentKind(
        "true-users:",
        "a driver with true road users",
        _partly_true(lights=False, users=True),
        "RUN",
        "trained",
        of_driver=True,
    ),
    AgentKind(
        "http://",
        "a planner in another process, behind neuro-ncap's model server protocol; ?timeout=S behind the "
        "address changes the 60 s in which it has to answer",
        lambda setup: remote_agents.build_http(
            setup.agent,
            setup.clock,
            cameras=setup.sees != "lidar",
            lidar=setup.sees in ("lidar", "both"),
        ),
        "HOST:PORT",
        "remote",
        ready=remote_agents.check_http,
    ),
    AgentKind(
        "grpc://",
        "a driver in another process, behind AlpaSim's contract",
        lambda setup: remote_agents.build_grpc(setup.agent, setup.clock),
        "HOST:PORT",
        "remote",
        ready=remote_agents.check_grpc,
    ),
    AgentKind(
        "python:",
        "a class of your own: its act(clip) returns points x, y, 0.5 s apart, and its needs name cameras, "
        "image_hw, lidar and past_frames; ?NAME=VALUE&… behind it are its arguments",
        _build_own,
        "FILE.py:CLASS",
        "declared",
    ),
    AgentKind(
        "navsim:",
        "an agent of NAVSIM's interface, whose arguments follow it as above",
        _build_own,
        "MODULE:CLASS",
        "declared",
    ),
    AgentKind(
        "",
        "the agent of a run folder; embedded or embedded:NAME comes with the package",
        _build_run,
        "RUN",
        "trained",
    ),
)
"""All agents: a new one is a row. The first whose name fits is taken."""


def find_agent(agent: str) -> tuple[AgentKind, str]:
    """Return the kind of an agent, and what follows the kind's name."""
    for kind in AGENTS:
        if agent == kind.name or (kind.argument and agent.startswith(kind.name)):
            return kind, agent.removeprefix(kind.name)
    raise AssertionError("the last kind fits every name")


def agents_help() -> str:
    """Return the help of the command line: a sentence about each agent."""
    return (
        "The agent that drives. "
        + "; ".join(f"{kind.name}{kind.argument}: {kind.knows}" for kind in (AGENTS[-1], *AGENTS[:-1]))
        + "."
    )


def absolute_name(agent: str) -> str:
    """Return the name of an agent for processes in other folders: with absolute paths of its run or file."""
    if find_agent(agent)[0].sensors == "declared":
        from foredrive.integrations.own_agents import absolute

        return absolute(agent)
    return str(Path(agent).absolute()) if Path(agent).is_dir() else agent


def is_foreign(agent: str) -> bool:
    """Return whether an agent is of another program, so that it is tried before the first drive."""
    return find_agent(agent)[0].sensors in ("remote", "declared")


def check_without_log(agent: str) -> None:
    """Check that an agent can drive where there is no log.

    Raises:
        InputError: it follows the path of a log.
    """
    if find_agent(agent)[0].of_log:
        raise InputError(
            f"the agent {agent} follows the path of a log and can drive only in a reconstruction"
        )


def make_agent(
    agent: str,
    clock: Callable[[], float],
    town: "TownSimulator | None" = None,
    seed: int = 0,
    sees: Sees | None = None,
) -> "Agent":
    """Create the agent of one drive.

    Args:
        agent: a name of `AGENTS`, with its argument.
        clock: returns the time of the drive, s.
        town: the town that the expert drives in; the other agents do not need it.
        seed: seed of the random disturbances and turns in a demonstration.
        sees: what an agent in another process is sent; None: cameras.

    Raises:
        InputError: there is no such agent, or it needs the expert and there is no town.
    """
    kind, argument = find_agent(agent)
    return kind.build(AgentSetup(agent, argument, clock, town, seed, sees))


def is_remote(agent: str) -> bool:
    """Return whether an agent is in another process. It remembers the frames that it was sent."""
    return find_agent(agent)[0].sensors == "remote"


def check_ready(agent: str) -> None:
    """Wait until an agent in another process is alive.

    Raises:
        InputError: it is not.
    """
    ready = find_agent(agent)[0].ready
    if ready is not None:
        ready(agent)


def agent_folder(agent: str, argument: str) -> Path:
    """Return the folder of an agent's run.

    Raises:
        InputError: there is none: the agent is unknown.
    """
    from foredrive.runs.shipped import run_folder

    folder = run_folder(Path(argument))
    if not folder.is_dir():
        names = ", ".join(f"{kind.name}{kind.argument}" for kind in AGENTS)
        raise InputError(f"unknown agent {agent!r}; the agents are {names}, embedded")
    return folder
