"""What the examples import of other programs that are not installed here."""

import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
from navsim_records import AbstractAgent, AgentInput, SensorConfig, Trajectory, TrajectorySampling

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], ModuleType]:
    """Import a file of the examples by its path, as other programs do."""

    def load(name: str) -> ModuleType:
        spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, name, module)
        spec.loader.exec_module(module)
        return module

    return load


@pytest.fixture
def navsim(monkeypatch: pytest.MonkeyPatch) -> None:
    """Modules with the records of NAVSIM's interface."""
    of = {
        "navsim.agents.abstract_agent": (AbstractAgent,),
        "navsim.common.dataclasses": (AgentInput, SensorConfig, Trajectory),
        "nuplan.planning.simulation.trajectory.trajectory_sampling": (TrajectorySampling,),
    }
    for name, members in of.items():
        parts = name.split(".")
        for end in range(1, len(parts) + 1):
            monkeypatch.setitem(sys.modules, ".".join(parts[:end]), ModuleType(".".join(parts[:end])))
        for member in members:
            setattr(sys.modules[name], member.__name__, member)
