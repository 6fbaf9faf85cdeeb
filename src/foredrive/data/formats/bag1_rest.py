"""Reader of ROS 1 bags without their index: cut off as a recorder leaves them (`.bag.active`), or damaged.

The format is ROS' "Bag format 2.0": records of a header and data, each behind its length. Chunks are records
that hold records; the last one of a bag that was not closed has no length yet, so its records follow it.
"""

import bz2
import functools
import io
import struct
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path

from foredrive.data.formats.bag_contents import Bag, Message, Topic, joined_topics, ros_decoder, ros_type
from foredrive.data.notices import note
from foredrive.errors import InputError

_MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _CHUNK, _CONNECTION = 2, 5, 7
_Found = tuple[str, str, int, bytes]
"""Topic, type, time (ns) and bytes of a message."""
Connections = dict[bytes, tuple[str, str]]
"""Topic and type by the number of a connection."""


def open_rest(path: Path) -> Bag:
    """Open a ROS 1 bag that has no index, with the messages that are whole.

    Raises:
        InputError: no message is whole.
    """
    counts: Counter[tuple[str, str]] = Counter()
    last_ns = 0
    for topic, kind, t_ns, _ in _messages(path, {}):
        counts[topic, kind] += 1
        last_ns = max(last_ns, t_ns)
    if not counts:
        raise InputError(f"{path}: no whole message in it; it is no bag, or was cut off at its start")
    read_to = f"{counts.total()} whole messages were read, to {last_ns * 1e-9:.3f} s"
    note(path.name, f"the recording was cut off; {read_to}")

    read = functools.partial(read_rest, path, {}, Counter())
    return Bag(joined_topics(Topic(*key, count) for key, count in counts.items()), read)


def read_rest(
    path: Path, connections: Connections, message_counts: Counter[tuple[str, int]], names: Collection[str]
) -> Iterator[Message]:
    """Yield the whole messages of some topics, without the index.

    Args:
        path: of the bag.
        connections: those that are known from the index. Others are read as they come.
        message_counts: number of messages that were read before, by topic and time, ns; they are left out.
        names: of the topics.
    """
    left = message_counts.copy()
    for topic, kind, t_ns, data in _messages(path, connections) if names else ():
        if left[topic, t_ns]:
            left[topic, t_ns] -= 1
        elif topic in names:
            yield Message(topic, t_ns * 1e-9, functools.partial(ros_decoder(1), data, kind))


def _messages(path: Path, connections: Connections) -> Iterator[_Found]:
    with path.open("rb") as file:
        if file.read(len(_MAGIC)) == _MAGIC:
            yield from _of_records(file, path.name, dict(connections))


def _of_records(stream: io.BufferedIOBase, bag: str, connections: Connections) -> Iterator[_Found]:
    """Yield the messages of a stream of records, up to where it is cut or damaged."""
    while (header := _sized(stream)) is not None:
        entries = _entries(header)
        kind = entries.get("op", b"\0")[0]
        if kind == _CHUNK:
            yield from _of_chunk(entries, stream, bag, connections)
            continue
        data = _sized(stream)
        if data is None:
            return
        if kind == _CONNECTION:
            name = ros_type(_entries(data).get("type", b"").decode())
            connections[entries.get("conn", b"")] = entries.get("topic", b"").decode(), name
        elif kind == _MESSAGE and entries.get("conn") in connections and len(entries.get("time", b"")) == 8:
            seconds, nanoseconds = struct.unpack("<II", entries["time"])
            yield *connections[entries["conn"]], seconds * 10**9 + nanoseconds, data


def _of_chunk(
    entries: dict[str, bytes], stream: io.BufferedIOBase, bag: str, connections: Connections
) -> Iterator[_Found]:
    """Yield the messages of a chunk, or note that it cannot be unpacked."""
    import lz4.frame

    start, size = stream.tell(), stream.read(4)
    data = stream.read(int.from_bytes(size, "little")) if len(size) == 4 else b""
    unpack = {b"bz2": bz2.decompress, b"lz4": lz4.frame.decompress}.get(
        entries.get("compression", b""), bytes
    )
    try:
        unpacked = unpack(data) if data else b""
    except (OSError, RuntimeError, ValueError, EOFError) as error:
        note(bag, "damaged chunks, left out", f"{len(data)} bytes from {start} on: {error}", once=True)
        return
    yield from _of_records(io.BytesIO(unpacked), bag, connections)


def _sized(stream: io.BufferedIOBase) -> bytes | None:
    """Return the bytes behind their length, or None where the stream ends before them."""
    size = stream.read(4)
    if len(size) < 4:
        return None
    length = int.from_bytes(size, "little")
    data = stream.read(length)
    return data if len(data) == length else None


def _entries(header: bytes) -> dict[str, bytes]:
    """Return the entries of a header: each is NAME=VALUE behind its length."""
    entries, stream = {}, io.BytesIO(header)
    while (entry := _sized(stream)) is not None:
        name, _, value = entry.partition(b"=")
        entries[name.decode(errors="replace")] = value
    return entries
