"""Opening of ROS 1 bags, ROS 2 bags and MCAP files of ROS or Foxglove messages."""

import contextlib
import functools
import importlib.util
import re
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path

from foredrive.data.formats.bag1_rest import open_rest, read_rest
from foredrive.data.formats.bag_contents import Bag, Message, Topic, joined_topics, ros_decoder
from foredrive.data.formats.mcap_files import open_mcap
from foredrive.data.notices import note
from foredrive.errors import InputError
from foredrive.plain_yaml import read_yaml

_METADATA = "metadata.yaml"
_PART = re.compile(r"(.+)_(\d+)\.(mcap|db3)")


def is_bag(path: Path) -> bool:
    """Return whether a path is that of one bag, and not of a folder of bags.

    The folder of a ROS 2 bag has its metadata, unless the recorder was cut off before it wrote them.
    """
    return path.is_file() or (path / _METADATA).is_file() or bool(_numbered(path))


@contextlib.contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a .bag, a ROS 2 bag (its folder, .db3 or .mcap), or an .mcap of Foxglove's messages.

    Raises:
        InputError: the packages are not installed, or it has another format.
    """
    for package in ("rosbags", "mcap"):
        if importlib.util.find_spec(package) is None:
            raise InputError(f"bags need the package {package}: pip install 'foredrive[bags]'")
    described = path.is_dir() and (path / _METADATA).is_file()
    parts = [path] if path.is_file() else _described(path) if described else _numbered(path)
    if parts and all(part.suffix == ".mcap" and part.is_file() for part in parts):
        if path.is_dir() and not described:
            note(path.name, f"no {_METADATA}; {len(parts)} files were read as one bag")
        yield open_mcap(parts)
    elif path.suffix == ".bag" or path.name.endswith(".bag.active"):
        with _open_ros1(path) as bag:
            yield bag
    elif path.suffix == ".db3" or described:
        with _open_ros2(path) as bag:
            yield bag
    elif parts and path.is_dir():
        raise InputError(f"{path}: a ROS 2 bag without metadata.yaml; write it by: ros2 bag reindex {path}")
    else:
        raise InputError(f"{path}: neither a .bag, .db3 or .mcap nor the folder of a ROS 2 bag")


def _described(folder: Path) -> list[Path]:
    """Return the files that the metadata of a ROS 2 bag name, and those that they should name."""
    # The reader of rosbags would follow aliases of aliases in the metadata for ever
    metadata = read_yaml(folder / _METADATA, "the metadata of a bag")
    bag = metadata.get("rosbag2_bagfile_information") if isinstance(metadata, dict) else None
    names = bag.get("relative_file_paths") if isinstance(bag, dict) else None
    files = [folder / Path(str(name)).name for name in names] if isinstance(names, list) else []
    # Metadata of a recorder that was cut off may end with an earlier file
    numbered = _numbered(folder)
    if not set(files) < set(numbered):
        return files
    for file in set(numbered) - set(files):
        note(folder.name, f"files that {_METADATA} does not name, read as well", file.name)
    return numbered


def _numbered(folder: Path) -> list[Path]:
    """Return the files of a ROS 2 bag without metadata: NAME_0.mcap, NAME_1.mcap, … or the same with .db3.

    Bags that have YAML files beside them are bags of their own.
    """
    if any(folder.glob("*.topics.yaml")):
        return []
    matches = [(match, file) for file in folder.glob("*") if (match := _PART.fullmatch(file.name))]
    files = [file for _, file in sorted((int(match[2]), file) for match, file in matches)]
    whole = sorted(int(match[2]) for match, _ in matches) == list(range(len(matches)))
    return files if whole and len({(match[1], match[3]) for match, _ in matches}) == 1 else []


@contextlib.contextmanager
def _open_ros1(path: Path) -> Iterator[Bag]:
    from rosbags.rosbag1 import Reader

    try:
        reader = Reader(path)
        reader.open()
    except Exception:  # of a bag without an index, rosbags 0.11 raises errors of several classes
        yield open_rest(path)
        return
    with contextlib.closing(reader):
        decode = ros_decoder(1)

        def read(names: Collection[str]) -> Iterator[Message]:
            # Only connections of the named topics are read
            wanted = [one for one in reader.connections if one.topic in names]
            message_counts = Counter[tuple[str, int]]()
            try:
                for connection, t_ns, data in reader.messages(connections=wanted) if wanted else ():
                    message_counts[connection.topic, t_ns] += 1
                    content = functools.partial(decode, data, connection.msgtype)
                    yield Message(connection.topic, t_ns * 1e-9, content)
            except Exception as error:  # of a damaged chunk, those of its compression too
                # The index leads no further: read the chunks one after the other
                reason = next(iter(str(error).splitlines()), type(error).__name__)
                note(path.name, f"damaged; read on without its index: {reason}", once=True)
                numbered = {one.id.to_bytes(4, "little"): (one.topic, one.msgtype) for one in wanted}
                yield from read_rest(path, numbered, message_counts, names)

        yield Bag(
            joined_topics(Topic(one.topic, one.msgtype, one.msgcount) for one in reader.connections), read
        )


@contextlib.contextmanager
def _open_ros2(path: Path) -> Iterator[Bag]:
    from rosbags.rosbag2 import Reader

    decode = ros_decoder(2)
    with Reader(path) as reader:

        def read(names: Collection[str]) -> Iterator[Message]:
            wanted = [one for one in reader.connections if one.topic in names]
            try:
                for connection, t_ns, data in reader.messages(connections=wanted) if wanted else ():
                    content = functools.partial(decode, data, connection.msgtype)
                    yield Message(connection.topic, t_ns * 1e-9, content)
            except Exception as error:  # sqlite3's in rosbags 0.10, apsw's in 0.11
                if type(error).__name__ not in ("DatabaseError", "CorruptError"):
                    raise
                note(path.name, f"the recording is damaged; what comes before that was read: {error}")

        yield Bag(
            joined_topics(Topic(one.topic, one.msgtype, one.msgcount) for one in reader.connections), read
        )
