"""Modules that agents of NAVSIM import, where its package or what that needs is not installed.

NAVSIM's own `navsim.common.dataclasses` imports nuPlan's devkit, which asks for Python 3.9. With records of
the same fields in its place, an agent's file runs without either. With a checkout of NAVSIM on PYTHONPATH its
own agents run too.
"""

import importlib
import importlib.util
import sys
from importlib.machinery import ModuleSpec
from types import ModuleType

from foredrive.integrations.navsim import records

SAMPLING = "nuplan.planning.simulation.trajectory.trajectory_sampling"
RECORDS = "navsim.common.dataclasses"
_MEMBERS = {
    SAMPLING: (records.TrajectorySampling,),
    "pytorch_lightning": (records.Callback,),
    RECORDS: (
        records.AgentInput,
        records.Camera,
        records.Cameras,
        records.EgoStatus,
        records.Lidar,
        records.Scene,
        records.SensorConfig,
        records.Trajectory,
        records.TrajectorySampling,
    ),
    "navsim.planning.training.abstract_feature_target_builder": (
        records.AbstractFeatureBuilder,
        records.AbstractTargetBuilder,
    ),
    "navsim.agents.abstract_agent": (records.AbstractAgent,),
}
"""Members of each module; modules that others import come first."""


def add_stand_ins() -> list[str]:
    """Put modules with NAVSIM's records in the place of those that cannot be imported; return their names."""
    added = []
    for name, members in _MEMBERS.items():
        try:
            importlib.import_module(name)
        except ImportError:
            added.append(name)
            _add(name, members)
    return added


def _add(name: str, members: tuple[type, ...]) -> None:
    module = _empty(name)
    for member in members:
        setattr(module, member.__name__, member)
    # Parents that exist stay as they are, so that the other modules of a checkout are found
    parents = name.split(".")[:-1]
    for end in range(1, len(parents) + 1):
        parent = ".".join(parents[:end])
        if parent not in sys.modules and importlib.util.find_spec(parent) is None:
            sys.modules[parent] = _empty(parent)
            sys.modules[parent].__path__ = []  # a package
    sys.modules[name] = module


def _empty(name: str) -> ModuleType:
    module = ModuleType(name)
    module.__spec__ = ModuleSpec(name, None)  # `find_spec` reads it
    return module
