"""Agents from files and modules of their users: a class that plans, and what it declares to need.

`python:FILE.py:CLASS` is a class of one's own, `navsim:MODULE:CLASS` one of NAVSIM's interface. Values of
arguments are written behind the class: `?checkpoint=FILE&width=64`. A function that returns an agent may take
the place of the class.
"""

import ast
import dataclasses
import functools
import importlib
import importlib.util
import inspect
import json
import sys
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, Literal
from urllib.parse import parse_qsl

import numpy as np
import torch
from pydantic import TypeAdapter, ValidationError

from foredrive.driving.observation import FRAME_DT_S, HORIZON_STEPS
from foredrive.driving.simple_agents import plan_of
from foredrive.errors import InputError
from foredrive.scene import Clip, Trajectory

NAVSIM, PYTHON = "navsim:", "python:"
_INSTALLED = ("site-packages", "dist-packages")
"""Names of the folders of installed packages."""


@dataclass(frozen=True)
class Needs:
    """The sensors that an agent is given. Speed, command and points of the route are always there."""

    cameras: tuple[str, ...] | Literal["all"] = ()
    """123D's names of the cameras, such as PCAM_F0, in the order in which it gets them."""
    image_hw: tuple[int, int] | None = None
    """Height and width of the images, px; None: any. Images of towns are rendered in this size."""
    lidar: bool = False
    past_frames: int = 1
    """Number of key frames before now, 0.5 s apart."""

    def __post_init__(self) -> None:
        if self.past_frames < 0 or (self.image_hw is not None and min(self.image_hw) < 1):
            raise ValueError(f"past_frames and image_hw must not be negative, got {self}")


def absolute(agent: str) -> str:
    """Return the name of an agent with an absolute path of its file, for processes in other folders."""
    if not agent.startswith(PYTHON):
        return agent
    file, name = _split(agent, PYTHON)
    return f"{PYTHON}{Path(file).absolute()}:{name}"


def needs_of(agent: str) -> Needs:
    """Return what an agent declares to need.

    Raises:
        InputError: there is no such class, or its declaration is not understood.
    """
    if agent.startswith(NAVSIM):
        from foredrive.integrations.navsim.agent import HISTORY, IMAGE_HW, sensors_of

        cameras, lidar = sensors_of(_instance(agent))
        return Needs(cameras, IMAGE_HW if cameras else None, lidar, HISTORY - 1)
    kind = _made_by(agent)[0]
    declared = getattr(kind if hasattr(kind, "needs") else _instance(agent), "needs", {})
    try:
        return TypeAdapter(Needs).validate_python(declared, extra="forbid")
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"][:1])
        raise InputError(f"{agent}: needs{f'.{where}' if where else ''}: {first['msg']}") from error


def files_of(agent: str) -> list[Path]:
    """Return the files that decide what an agent does, in a fixed order.

    They are its own file, the files beside it that these import, also in functions, and those that its
    arguments name, or that lie in folders they name. Of installed packages only the agent's own counts.

    Raises:
        InputError: there is no such class.
    """
    _, arguments = _made_by(agent)
    place, _ = _split(agent, NAVSIM if agent.startswith(NAVSIM) else PYTHON)
    if agent.startswith(NAVSIM):
        # The folder in which the imports of a module begin is above all packages of its name
        file = Path(inspect.getfile(sys.modules[place]))
        root = file.parents[place.count(".") + (file.name == "__init__.py")].absolute()
        todo = [file.absolute(), *_modules(root, place)]
        below = root / place.partition(".")[0] if root.name in _INSTALLED else root
    else:
        root = below = Path(place).absolute().parent
        todo = [Path(place).absolute()]
    files = list[Path]()
    while todo:
        if (path := todo.pop()) not in files:
            files.append(path)
            todo += (module for module in _imported(path, root) if module.is_relative_to(below))
    named = [Path(value).absolute() for value in arguments.values() if isinstance(value, str)]
    # Of a folder around the present one, which may get results, nothing counts
    folders = [path for path in named if path.is_dir() and not Path.cwd().is_relative_to(path)]
    named += [path for folder in folders for path in folder.rglob("*")]
    return sorted(files) + sorted(path for path in named if path.is_file())


def _imported(file: Path, root: Path) -> Iterator[Path]:
    """Yield the files below a folder that a Python file imports from there.

    A file that is no Python imports nothing: an import that fails may be one that the agent does without.
    """
    try:
        tree = ast.parse(file.read_bytes())
    except (SyntaxError, ValueError):
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names, base = [alias.name for alias in node.names], root
        elif isinstance(node, ast.ImportFrom):
            # What is imported from a package may be a module of it
            names = [f"{node.module or ''}.{alias.name}".strip(".") for alias in node.names]
            names += [node.module or ""]
            base = file.parents[node.level - 1] if node.level else root
        else:
            continue
        for name in names:
            yield from _modules(base, name)


def _modules(base: Path, name: str) -> Iterator[Path]:
    """Yield the file of a module below a folder, and those of the packages that are imported on its way."""
    path = base
    for part in name.split(".") if name else ():
        path /= part
        yield from (module for module in (path.with_suffix(".py"), path / "__init__.py") if module.is_file())


def own_agent(agent: str) -> "OwnAgent":
    """Return the agent of one drive. An instance with a method `reset` serves all drives of a process.

    Raises:
        InputError: there is no such class, or it cannot be made.
    """
    if agent.startswith(NAVSIM):
        from foredrive.integrations.navsim.agent import NavsimPlanner

        return OwnAgent(agent, NavsimPlanner(_instance(agent)).plan, needs_of(agent))
    instance = _instance(agent) if hasattr(_made_by(agent)[0], "reset") else _make(agent)
    if hasattr(instance, "reset"):
        instance.reset()
    return OwnAgent(agent, instance.act, needs_of(agent))


@dataclass(frozen=True, eq=False)
class OwnAgent:
    """An `Agent` that asks an object of a user's class. It is shown no truth: no boxes."""

    name: str
    plan: Callable[[Clip], Any]
    """Returns a plan for an unbatched clip."""
    needs: Needs

    def act(self, observation: Clip) -> Trajectory:
        """Return the object's plan, for a batch of one.

        Raises:
            InputError: a declared input is missing, or the answer is no plan.
        """
        clip = observation[0].observed()
        boxes = clip.boxes.map_tensors(torch.zeros_like)
        clip = dataclasses.replace(clip, boxes=boxes, boxes_valid=torch.zeros_like(clip.boxes_valid))
        if self.needs.cameras != "all":
            clip = clip.through([_camera(clip, name, self.name) for name in self.needs.cameras])
        return plan_of(torch.from_numpy(_waypoints(self.plan(clip), self.name))[None, None])


def _camera(clip: Clip, name: str, agent: str) -> int:
    names = [camera.lower() for camera in clip.rig.names]
    if name.lower() not in names:
        raise InputError(f"{agent}: needs the camera {name}; there are {', '.join(clip.rig.names) or 'none'}")
    return names.index(name.lower())


def _waypoints(answer: Any, agent: str) -> "np.ndarray[Any, np.dtype[np.float32]]":
    """Return the points of 3 s of a plan: [T, 2] or more columns, 0.5 s apart, or a `Trajectory`.

    Raises:
        InputError: it has too few points, other shapes or times, or numbers that are not finite.
    """
    if isinstance(answer, Trajectory):
        if abs(answer.dt_s - FRAME_DT_S) > 1e-6:
            raise InputError(f"{agent}: plans are {FRAME_DT_S} s apart, not {answer.dt_s}")
        log_prob, xy = answer.log_prob.reshape(-1, answer.xy.shape[-3])[0], answer.xy
        answer = xy.reshape(-1, *xy.shape[-3:])[0][int(log_prob.argmax())]
    points = np.asarray(
        answer.detach().cpu() if isinstance(answer, torch.Tensor) else answer, dtype=np.float32
    )
    if points.ndim != 2 or points.shape[1] not in (2, 3) or len(points) < HORIZON_STEPS:
        wanted = f"at least {HORIZON_STEPS} points x, y (and heading), {FRAME_DT_S} s apart"
        raise InputError(f"{agent}: a plan has {wanted}; got an array {list(points.shape)}")
    if not np.isfinite(points).all():
        raise InputError(f"{agent}: a plan has points that are not finite: {points[:HORIZON_STEPS].tolist()}")
    return np.ascontiguousarray(points[:HORIZON_STEPS, :2])


@functools.lru_cache(maxsize=1)  # weights are read once a process
def _instance(agent: str) -> Any:
    instance = _make(agent)
    if agent.startswith(NAVSIM):
        _of_user(agent, instance.initialize)
    return instance


def _make(agent: str) -> Any:
    make, arguments = _made_by(agent)
    try:
        inspect.signature(make).bind(**arguments)
    except TypeError as error:
        raise InputError(f"{agent}: {error}; arguments are written behind it: ?NAME=VALUE&…") from error
    return _of_user(agent, lambda: make(**arguments))


def _of_user(agent: str, made: Callable[[], Any]) -> Any:
    """Return what a user's own code makes.

    Raises:
        InputError: it raises an error, as where a checkpoint is missing. The message has the error and its
            place.
    """
    try:
        return made()
    except Exception as error:  # any error of the user's own code
        lines = traceback.extract_tb(error.__traceback__)
        # The last line of the user's own code; what is below are the libraries that it calls
        place = next((line for line in reversed(lines) if "site-packages" not in line.filename), lines[-1])
        text = f"{type(error).__name__}: {error}".splitlines()[0]
        raise InputError(
            f"{agent}: cannot be made: {text} ({place.filename}, line {place.lineno})"
        ) from error


def _made_by(agent: str) -> tuple[Callable[..., Any], dict[str, Any]]:
    """Return the class of an agent, or a function that returns one, and the values of its arguments.

    Raises:
        InputError: there is no such file, module or class.
    """
    kind = NAVSIM if agent.startswith(NAVSIM) else PYTHON
    place, name = _split(agent, kind)
    name, _, query = name.partition("?")
    arguments = {key: _value(text) for key, text in parse_qsl(query, keep_blank_values=True)}
    module = _navsim_module(place) if kind == NAVSIM else _file_module(Path(place))
    make = getattr(module, name, None)
    if not callable(make):
        classes = [key for key, value in vars(module).items() if inspect.isclass(value)]
        raise InputError(f"{agent}: no class {name} in {place}; there are {', '.join(classes) or 'none'}")
    return make, arguments


def _value(text: str) -> Any:
    """Return a value as JSON writes it, such as 64, 1e-4 or true; anything else is a text."""
    try:
        return json.loads(text)
    except ValueError:
        return text


def _split(agent: str, kind: str) -> tuple[str, str]:
    whole, mark, query = agent.removeprefix(kind).partition("?")
    place, colon, name = whole.rpartition(":")
    if not colon or not place or not name:
        form = "MODULE:CLASS" if kind == NAVSIM else "FILE.py:CLASS"
        raise InputError(f"{agent}: this agent is named {kind}{form}")
    return place, f"{name}{mark}{query}"


@functools.lru_cache(maxsize=8)
def _file_module(file: Path) -> ModuleType:
    """Import a file. Modules beside it can be imported, as in a script."""
    if not file.is_file():
        raise InputError(f"{file}: no such file")
    # Under a name of its own: a file may be called as a module that is imported, such as queue.py
    spec = importlib.util.spec_from_file_location(f"own_agent_{file.stem}", file)
    if spec is None or spec.loader is None:
        raise InputError(f"{file}: this is no Python file")
    if str(file.parent) not in sys.path:
        sys.path.append(str(file.parent))
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # any error of the user's own code
        raise InputError(f"{file}: cannot be imported: {type(error).__name__}: {error}") from error
    return module


def _navsim_module(name: str) -> ModuleType:
    from foredrive.integrations.navsim.stand_ins import add_stand_ins

    if "" not in sys.path and str(Path.cwd()) not in sys.path:
        sys.path.append(str(Path.cwd()))
    add_stand_ins()
    try:
        return importlib.import_module(name)
    except Exception as error:  # any error of the user's own code
        hint = "; is its folder on PYTHONPATH?" if isinstance(error, ModuleNotFoundError) else ""
        raise InputError(f"{name}: cannot be imported: {type(error).__name__}: {error}{hint}") from error
