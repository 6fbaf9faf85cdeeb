"""Files of scenarios: ours with any number of scenarios, and neuro-ncap's with one each, as they are.

All scalars are read as text and converted where a number is meant, so that a scene `0101` or a token `1e05`
remains a name; YAML would make the numbers 65 and 100000 of them.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from pydantic import TypeAdapter, ValidationError

from foredrive.driving.ncap.scenario import Jitter, Point, Polyline, SafetyScenario, ScenarioActor
from foredrive.driving.observation import FRAME_DT_S
from foredrive.driving.replay.threats import Threat
from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.plain_yaml import read_yaml

UNREAD = ("start_pose", "start_velo", "smooth_actors", "actor_framerate")
"""Settings of neuro-ncap's files that its code does not read, or that have one value in all of its files."""
OUTSIDE_PROTOCOL = ("stationary/0061.yaml",)
"""Files in neuro-ncap's folder that are not among the 20 scenarios of its protocol: "do not use for eval"."""


def load_scenarios(path: Path) -> tuple[SafetyScenario, ...]:
    """Read a file of ours, one of neuro-ncap's, or a folder of files.

    The kind of a scenario of neuro-ncap is the name of its file's folder, and its scene that of the file. The
    files of a folder that are `outside_protocol` are left out. Such a file is read if it is named itself.

    Raises:
        InputError: a file cannot be read, an entry is wrong, or two scenarios have one name.
    """
    # Files that are named directly are read; those outside of the protocol are left out of folders
    outside = outside_protocol(path)
    files = sorted(path.rglob("*.yaml")) if path.is_dir() else [path]
    scenarios = tuple(entry for file in files if file not in outside for entry in _read(file))
    if not scenarios:
        raise InputError(f"{path}: there are no scenarios")
    labels = [scenario.label for scenario in scenarios]
    if twice := sorted({label for label in labels if labels.count(label) > 1}):
        raise InputError(f"{path}: several scenarios have the name {twice[0]}")
    return scenarios


def outside_protocol(path: Path) -> Mapping[Path, str]:
    """Return the label of each file in a folder that does not belong to neuro-ncap's protocol."""
    files = path.rglob("*.yaml") if path.is_dir() else ()
    outside = (file for file in files if f"{file.parent.name}/{file.name}" in OUTSIDE_PROTOCOL)
    return {file: f"{file.parent.name}-{file.stem}" for file in outside}


def save_scenarios(scenarios: Sequence[SafetyScenario], path: Path) -> None:
    """Write scenarios in our format."""
    plain = TypeAdapter(list[SafetyScenario]).dump_python(list(scenarios), mode="json")
    with atomic_path(path) as temporary:
        temporary.write_text(
            yaml.safe_dump({"scenarios": plain}, sort_keys=False, default_flow_style=None, width=110)
        )


def _read(file: Path) -> list[SafetyScenario]:
    written = read_yaml(file, as_text=True)
    if not isinstance(written, Mapping):
        raise InputError(f"{file}: not a file of scenarios")
    if "general" in written:
        return [_neuro_ncap(written, file)]
    if set(written) != {"scenarios"}:
        raise InputError(f"{file}: not a file of scenarios (no entry `scenarios`, and no `general`)")
    read: list[SafetyScenario] = _validated(list[SafetyScenario], _without_none(written["scenarios"]), file)
    return read


def _validated(kind: Any, written: Any, file: Path) -> Any:
    try:
        return TypeAdapter(kind).validate_python(written, extra="forbid")
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        why = str(first["msg"]).removeprefix("Value error, ")
        raise InputError(f"{file}: {f'{where}: ' if where else ''}{why}") from error


def _without_none(values: Any) -> Any:
    """Return values without entries that are "null"."""
    if isinstance(values, dict):
        return {key: _without_none(value) for key, value in values.items() if value not in ("null", "")}
    return [_without_none(value) for value in values] if isinstance(values, list) else values


@dataclass(frozen=True)
class _General:
    """The part `general` of neuro-ncap's files, with its defaults."""

    start_frame: int = 0
    priming_steps: int = 1
    time_step: float = FRAME_DT_S
    duration: float = 20.0
    dim_jitter: float = 0.0
    start_jitter: int = 0


@dataclass(frozen=True)
class _JitterThere:
    """The part `jitter` of an actor there."""

    longitudinal: float = 0.0
    lateral: float = 0.0
    long_lat_angle: float | None = None
    yaw_jitter: float = 0.0
    uniform: bool = True
    times: tuple[float, ...] = ()


@dataclass(frozen=True)
class _ActorThere:
    """An entry of `actors` there."""

    times: tuple[float, ...]
    positions: tuple[Point, ...]
    mode: str = ""
    uuid: str | None = None
    uuids: tuple[str, ...] = ()
    flip_uuids: tuple[str, ...] = ()
    is_target_actor: bool = False
    initial_yaw: float = 0.0
    jitter: _JitterThere = dataclasses.field(default_factory=_JitterThere)
    exclusive_group: str | None = None


def _neuro_ncap(written: Mapping[str, Any], file: Path) -> SafetyScenario:
    """Return the scenario of a file of neuro-ncap."""
    kind, name = file.parent.name, file.stem
    if kind not in set(Threat):
        raise InputError(
            f"{file}: the kind of a scenario of neuro-ncap is the name of its folder: one of "
            f"{', '.join(Threat)}, not {kind!r}"
        )
    # neuro-ncap writes dashes in its keys
    plain = _underscored(written)
    general = {key: value for key, value in plain["general"].items() if key not in UNREAD}
    settings: _General = _validated(_General, general, file)
    actors: list[_ActorThere] = _validated(list[_ActorThere], plain.get("actors") or [], file)
    if settings.time_step != FRAME_DT_S or settings.dim_jitter:
        raise InputError(f"{file}: time-step must be {FRAME_DT_S:g} and dim-jitter 0")
    if any(actor.mode != "override" for actor in actors):
        raise InputError(f"{file}: only actors of the mode override are known")
    targets = [index for index, actor in enumerate(actors) if actor.is_target_actor]
    try:
        return SafetyScenario(
            name=name,
            kind=Threat(kind),
            scene=name,
            start_frame=settings.start_frame,
            length_s=settings.duration,
            actors=tuple(map(_actor, actors)),
            priming_frames=settings.priming_steps,
            start_jitter_frames=settings.start_jitter,
            target=targets[0] if targets else 0,
        )
    except InputError as error:
        raise InputError(f"{file}: {error}") from error


def _actor(stated: _ActorThere) -> ScenarioActor:
    # Without an angle, the shift has no direction and is not applied
    shift = stated.jitter if stated.jitter.long_lat_angle is not None else None
    return ScenarioActor(
        names=stated.uuids or ((stated.uuid,) if stated.uuid else ()),
        way=Polyline(stated.times, stated.positions),
        yaw_rad=stated.initial_yaw,
        flipped=stated.flip_uuids,
        jitter=Jitter(
            along_rad=stated.jitter.long_lat_angle or 0.0,
            longitudinal_m=shift.longitudinal if shift else 0.0,
            lateral_m=shift.lateral if shift else 0.0,
            yaw_rad=stated.jitter.yaw_jitter,
            uniform=stated.jitter.uniform,
        ),
        group=stated.exclusive_group,
    )


def _underscored(values: Any) -> Any:
    """Return values with underscores for dashes in all keys."""
    if isinstance(values, Mapping):
        return {key.replace("-", "_"): _underscored(value) for key, value in values.items()}
    return [_underscored(value) for value in values] if isinstance(values, list) else values
