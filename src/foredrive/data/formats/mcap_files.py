"""MCAP files of ROS 1, ROS 2 and Foxglove (protocol buffers and JSON), closed or cut off."""

import functools
import heapq
import importlib
import importlib.util
import json
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from foredrive.data.formats.bag_contents import (
    KINDS,
    Bag,
    Message,
    Topic,
    joined_topics,
    ros_decoder,
    ros_type,
)
from foredrive.data.notices import note
from foredrive.errors import InputError

if TYPE_CHECKING:
    from mcap.records import Channel, ChunkIndex, Schema
    from mcap.records import Message as Record

    Found = tuple[Schema | None, Channel, Record]


@dataclass(frozen=True)
class _File:
    """One file and what it holds."""

    path: Path
    schemas: "dict[int, Schema]"
    channels: "dict[int, Channel]"
    counts: Counter[int]
    """Number of messages by channel."""
    chunks: "Sequence[ChunkIndex]" = ()
    """Chunks by their summary. Without any, the file is read from its start."""


def open_mcap(paths: Sequence[Path]) -> Bag:
    """Return what MCAP files hold, one after the other.

    A file without a summary is read from its start. If it was cut off, it gives the messages that are whole.
    A damaged chunk is left out with a notice.

    Raises:
        InputError: a file holds no whole message, or a package is missing.
    """
    files = [_indexed(path) or _scanned(path) for path in paths]
    decoders = [_decoders(file) for file in files]
    topics = joined_topics(
        _topic(file, channel, decoders[number].get(channel.id))
        for number, file in enumerate(files)
        for channel in file.channels.values()
    )

    def read(names: Collection[str]) -> Iterator[Message]:
        for file, decoder in zip(files, decoders, strict=True):
            for _, channel, record in _messages(file, names) if names else ():
                decode = decoder.get(channel.id)
                if callable(decode):
                    content = functools.partial(decode, record.data)
                    yield Message(channel.topic, record.log_time * 1e-9, content)

    return Bag(topics, read)


def _topic(file: _File, channel: "Channel", decoder: Callable[[bytes], Any] | str | None) -> Topic:
    schema = file.schemas.get(channel.schema_id)
    unread = decoder if isinstance(decoder, str) else None
    name = "" if schema is None else schema.name
    return Topic(channel.topic, ros_type(name) if "/" in name else name, file.counts[channel.id], unread)


def _indexed(path: Path) -> _File | None:
    """Return what the summary of a file says, or None if it has no summary or one without counts."""
    from mcap.reader import make_reader

    with (
        path.open("rb") as file,
        suppress(Exception),
    ):  # of a cut file, the library raises errors of many classes
        summary = make_reader(file).get_summary()
        if summary is None or summary.statistics is None or not summary.chunk_indexes:
            return None
        counts = Counter(summary.statistics.channel_message_counts)
        if set(counts) <= set(summary.channels):
            return _File(path, summary.schemas, summary.channels, counts, summary.chunk_indexes)
    return None


def _scanned(path: Path) -> _File:
    """Return what a file without a usable summary holds.

    Raises:
        InputError: it holds no whole message.
    """
    from mcap.records import Channel, Footer, Schema

    content = _File(path, {}, {}, Counter())
    last_ns, ends = 0, False
    for record in _records(path):
        if isinstance(record, Schema):
            content.schemas[record.id] = record
        elif isinstance(record, Channel):
            content.channels[record.id] = record
        elif isinstance(record, Footer):
            ends = True
        else:
            content.counts[record.channel_id] += 1
            last_ns = max(last_ns, record.log_time)
    # A channel may be described behind its messages alone, where the chunk that opened it is damaged
    count = sum(content.counts[number] for number in content.channels)
    if not count:
        raise InputError(f"{path}: no whole message in it; it is no MCAP file, or was cut off at its start")
    if not ends:
        note(
            path.name,
            f"the recording was cut off; {count} whole messages were read, to {last_ns * 1e-9:.3f} s",
        )
    return content


def _messages(file: _File, names: Collection[str]) -> "Iterator[Found]":
    """Yield the messages of topics: in the order of time by a summary, else in that of the file."""
    wanted = {number for number, channel in file.channels.items() if channel.topic in names}
    for record in _sorted_records(file, wanted) if file.chunks else _records(file.path):
        if getattr(record, "channel_id", None) in wanted:
            channel = file.channels[record.channel_id]
            yield file.schemas.get(channel.schema_id), channel, record


def _sorted_records(file: _File, wanted: Collection[int]) -> Iterator[Any]:
    """Yield the messages of the chunks that hold wanted channels, in the order of time."""
    from mcap.data_stream import ReadDataStream
    from mcap.records import Chunk, Message

    # Messages of chunks that overlap in time wait here for each other
    waiting: list[tuple[int, int, int, Message]] = []
    with file.path.open("rb") as opened:
        for index in sorted(file.chunks, key=lambda chunk: chunk.message_start_time):
            if index.message_index_offsets and set(wanted).isdisjoint(index.message_index_offsets):
                continue
            while waiting and waiting[0][0] < index.message_start_time:
                yield heapq.heappop(waiting)[-1]
            opened.seek(index.chunk_start_offset + 9)  # behind the kind and the length of the record
            for number, record in enumerate(_opened(Chunk.read(ReadDataStream(opened)), file.path)):
                if isinstance(record, Message) and record.channel_id in wanted:
                    heapq.heappush(waiting, (record.log_time, index.chunk_start_offset, number, record))
    while waiting:
        yield heapq.heappop(waiting)[-1]


def _records(path: Path) -> Iterator[Any]:
    """Yield the schemas, channels and messages of a file from its start, and its footer if it has one."""
    from mcap.records import Channel, Chunk, Footer, Message, Schema
    from mcap.stream_reader import StreamReader

    with path.open("rb") as file, suppress(Exception):
        for record in StreamReader(file, emit_chunks=True).records:
            if isinstance(record, Chunk):
                yield from _opened(record, path)
            elif isinstance(record, Schema | Channel | Message | Footer):
                yield record


def _opened(chunk: Any, path: Path) -> Iterator[Any]:
    """Yield the schemas, channels and messages of a chunk. A damaged one is noted, and costs itself alone."""
    try:
        yield from _unpacked(chunk)
    except Exception as error:  # of the compression, and of any record
        span = " to ".join(f"{ns * 1e-9:.3f}" for ns in (chunk.message_start_time, chunk.message_end_time))
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        note(path.name, "damaged chunks, left out", f"recorded at {span} s: {reason}", once=True)


def _unpacked(chunk: Any) -> Iterator[Any]:
    """Yield the records of a chunk, up to where it is cut."""
    from mcap.opcode import Opcode
    from mcap.records import Channel, Schema
    from mcap.records import Message as Record
    from mcap.stream_reader import get_chunk_data_stream

    stream, size = get_chunk_data_stream(chunk, validate_crc=True)
    while stream.count < size:
        opcode, length = stream.read1(), stream.read8()
        if stream.count + length > size:
            return
        if opcode == Opcode.MESSAGE:
            yield Record.read(stream, length)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            yield (Schema if opcode == Opcode.SCHEMA else Channel).read(stream)
        else:
            stream.read(length)


def _decoders(file: _File) -> dict[int, Callable[[bytes], Any] | str]:
    """Return for each channel what decodes its messages, or why there is nothing that does.

    Raises:
        InputError: the package of protocol buffers is missing.
    """
    decoders: dict[int, Callable[[bytes], Any] | str] = {}
    protobuf: Any = None
    for channel in file.channels.values():
        schema = file.schemas.get(channel.schema_id)
        name = "" if schema is None else schema.name
        match channel.message_encoding:
            case "cdr":
                decoders[channel.id] = functools.partial(_ros, 2, ros_type(name))
            case "ros1":
                decoders[channel.id] = functools.partial(_ros, 1, ros_type(name))
            case "protobuf":
                _check_protobuf()
                if protobuf is None:
                    from mcap_protobuf.decoder import DecoderFactory

                    protobuf = DecoderFactory()
                decoders[channel.id] = functools.partial(_protobuf, protobuf, schema)
            case "json" if name.startswith("foxglove."):
                _check_protobuf()
                decoders[channel.id] = functools.partial(_json, name)
            case "json":
                decoders[channel.id] = "JSON is read of Foxglove's schemas only; record ROS messages as such"
            case encoding:
                decoders[channel.id] = f"messages of encoding {encoding!r} are not read"
    return decoders


def _check_protobuf() -> None:
    for package in ("mcap_protobuf", "foxglove_schemas_protobuf"):
        if importlib.util.find_spec(package) is None:
            raise InputError(
                f"Foxglove's MCAP needs {package.replace('_', '-')}: pip install 'foredrive[bags]'"
            )


def _ros(version: Any, name: str, data: bytes) -> Any:
    return ros_decoder(version)(data, name)


def _protobuf(factory: Any, schema: Any, data: bytes) -> Any:
    decode = factory.decoder_for("protobuf", schema)
    if decode is None:
        raise InputError("a message without the description of its protocol buffers")
    return decode(data)


def _json(name: str, data: bytes) -> Any:
    """Return a message of one of Foxglove's schemas, as the protocol buffer of the same schema."""
    from google.protobuf import json_format

    if name not in KINDS:
        raise InputError(f"messages of {name} are not read")
    short = name.removeprefix("foxglove.")
    made = getattr(importlib.import_module(f"foxglove_schemas_protobuf.{short}_pb2"), short)()
    values = json.loads(data, object_hook=_with_time)
    return json_format.ParseDict(values, made, ignore_unknown_fields=True)


def _with_time(entries: dict[str, Any]) -> Any:
    """Return a time in text, as protocol buffers have it in JSON; other objects as they are."""
    if set(entries) != {"sec", "nsec"}:
        return entries
    whole = datetime.fromtimestamp(entries["sec"], UTC).strftime("%Y-%m-%dT%H:%M:%S")
    return f"{whole}.{entries['nsec']:09d}Z"
