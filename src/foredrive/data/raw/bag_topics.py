"""The YAML that says which topics of a bag are cameras, lidar and poses, and a proposal of it."""

import itertools
from collections.abc import Iterator
from pathlib import Path

import yaml
from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from foredrive.data.raw.bag_files import Bag, Topic, open_bag
from foredrive.data.raw.bag_messages import Placed, read_cloud, read_placed
from foredrive.data.raw.frame_tree import FrameTree
from foredrive.errors import InputError
from foredrive.files import atomic_path

_EGO_NAMES = ("base_link", "base_footprint", "ego", "ego_vehicle", "vehicle", "imu_link", "imu")
_WORLD_NAMES = ("map", "odom", "world", "global", "earth", "utm")


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class CameraTopics(_Strict):
    """The topics of one camera."""

    images: str
    info: str
    frame: str | None = None
    """The optical frame: x to the right, y down, z ahead. None: as the images say."""


class LidarTopic(_Strict):
    """The topic of the lidar."""

    topic: str
    intensity_max: float = 255.0
    """Stored intensity that is 1."""
    compensated: bool = False
    """True if the driver of the lidar has removed the vehicle's motion within a sweep."""
    frame: str | None = None


class BagTopics(_Strict):
    """The topics of a bag that become a log."""

    name: str
    """Name of the log."""
    world_frame: str
    ego_frame: str
    """x ahead, y to the left, z up (REP 103)."""
    ego_origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Point on the ground below the middle of the rear axle, in `ego_frame`."""
    pose: str | None = None
    """Topic with poses of `ego_frame` in `world_frame`. None: the transforms have them."""
    cameras: dict[str, CameraTopics] = {}
    lidar: LidarTopic | None = None
    split: str = "own_train"


def topics_file(bag: Path) -> Path:
    """Return where the YAML of a bag lies, unless another file is named: beside the bag."""
    return bag.parent / f"{bag.name}.topics.yaml"


def read_topics(file: Path) -> BagTopics:
    """Read and check the YAML.

    Raises:
        InputError: the file cannot be read, or an entry is missing, unknown or of another type.
    """
    try:
        return TypeAdapter(BagTopics).validate_python(yaml.safe_load(file.read_text()))
    except OSError as error:
        raise InputError(f"{file}: cannot be read: {error.strerror or error}") from error
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"{file}: not YAML: {(str(error).splitlines() or [''])[0]}") from error
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise InputError(f"{file}: {place or 'the file'}: {first['msg']}") from error


def propose_topics(bag: Path, file: Path) -> str:
    """Write a YAML of what a bag holds, and return it. An existing file is not replaced.

    Raises:
        InputError: the file is there, or the bag cannot be read or has no images and points.
    """
    if file.exists():
        raise InputError(f"{file}: is there already; remove it to propose topics anew")
    with open_bag(bag) as opened:
        found = _proposal(opened, bag)
        lines = [f"# {topic.name}: {topic.type}, {topic.count} messages" for topic in opened.topics.values()]
    text = "\n".join(
        [f"# Topics of {bag.name}, proposed by foredrive convert rosbag; all topics:", *sorted(lines), ""]
    ) + yaml.safe_dump(found.model_dump(exclude_defaults=True), sort_keys=False)
    with atomic_path(file) as temporary:
        temporary.write_text(text)
    return text


def _proposal(bag: Bag, path: Path) -> BagTopics:
    by_kind: dict[str, list[Topic]] = {}
    for topic in bag.topics.values():
        if topic.kind is not None and topic.count:
            by_kind.setdefault(topic.kind, []).append(topic)
    if not {"image", "points"} & set(by_kind):
        raise InputError(
            f"{path}: no topic with images or points; there are: {', '.join(bag.topics) or 'none'}"
        )
    pose = next((one.name for kind in ("odometry", "pose") for one in by_kind.get(kind, [])), None)
    names = [one.name for kind in ("tf", "odometry", "pose") for one in by_kind.get(kind, [])]
    placed = [one for _, message in bag.read(names) for one in read_placed(message)]
    world, ego = _world_and_ego(placed, pose is not None)
    lidar = max(by_kind.get("points", []), key=lambda one: one.count, default=None)
    return BagTopics(
        name=_plain(path.stem),
        world_frame=world,
        ego_frame=ego,
        pose=pose,
        cameras=dict(_cameras(by_kind.get("image", []), by_kind.get("info", []), bag)),
        lidar=None if lidar is None else _lidar(lidar, bag),
    )


def _world_and_ego(placed: list[Placed], has_pose: bool) -> tuple[str, str]:
    """Return the frames of the world and of the vehicle: by their usual names, else the first that moves."""
    own = [one for one in placed if not one.child]
    frames = FrameTree(one for one in placed if one.child).frames
    lower = {name.lower(): name for name in sorted(frames)}
    ego = next((lower[name] for name in _EGO_NAMES if name in lower), None)
    world = next((lower[name] for name in _WORLD_NAMES if name in lower), None)
    if has_pose and own:
        world = own[0].parent
    moving = [one for one in placed if one.child]
    if ego is None or world is None:
        ego = ego or (moving[0].child if moving else "base_link")
        world = world or (moving[0].parent if moving else "map")
    return world, ego


def _cameras(images: list[Topic], infos: list[Topic], bag: Bag) -> Iterator[tuple[str, CameraTopics]]:
    """Yield a camera for each topic of images with the calibration that shares most of its name."""
    taken: set[str] = set()
    for topic in sorted(images, key=lambda one: (not one.type.endswith("CompressedImage"), one.name)):
        info = max(infos, key=lambda one: _shared(one.name, topic.name), default=None)
        if info is None or info.name in taken:
            continue
        taken.add(info.name)
        parts = [part for part in topic.name.split("/") if part]
        kinds = ("image", "compressed", "raw", "color", "rect", "rgb")
        named = [part for part in parts if not any(part.startswith(kind) for kind in kinds)]
        yield _plain(named[-1] if named else parts[-1]), CameraTopics(images=topic.name, info=info.name)


def _lidar(topic: Topic, bag: Bag) -> LidarTopic:
    _, message = next(bag.read([topic.name]))
    cloud = read_cloud(message)
    largest = 0.0 if cloud.intensity is None or not cloud.intensity.size else float(cloud.intensity.max())
    scale = next((scale for scale in (1.0, 255.0, 65_535.0) if largest <= scale), largest)
    return LidarTopic(topic=topic.name, intensity_max=scale, compensated=cloud.dt_s is None)


def _shared(first: str, second: str) -> int:
    """Return the number of leading parts that two topics share."""
    pairs = zip(first.split("/"), second.split("/"), strict=False)
    return len(list(itertools.takewhile(lambda pair: pair[0] == pair[1], pairs)))


def _plain(name: str) -> str:
    """Return a name of letters, digits, dots, dashes and underscores."""
    return "".join(each if each.isalnum() or each in "._-" else "_" for each in name).lstrip(".") or "bag"
