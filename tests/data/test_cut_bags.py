"""Recordings that were cut off give what is whole in them, and MCAP files are read whatever they hold."""

import base64
import json
import re
from pathlib import Path

import made_bags
import numpy as np
import pytest
from mcap.writer import Writer
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin

from foredrive.data.formats.bag_contents import Bag
from foredrive.data.formats.bag_files import open_bag
from foredrive.data.formats.bag_messages import read_cloud, read_placed, stamp_us
from foredrive.data.formats.bag_proposal import propose_topics
from foredrive.data.formats.bag_topics import topics_file
from foredrive.data.formats.convert import convert
from foredrive.data.logs import Log
from foredrive.data.notices import collecting, note, read_notices, write_notices
from foredrive.errors import InputError


def counted(bag: Bag) -> dict[str, int]:
    """The number of messages that are read and can be decoded, by topic."""
    counts = dict.fromkeys(bag.topics, 0)
    for message in bag.read(list(bag.topics)):
        message.decode()
        counts[message.topic] += 1
    return counts


@pytest.mark.parametrize(("once", "count"), [(True, 7), (False, 14)])
def test_a_second_pass_counts_places_anew_unless_they_count_once(
    once: bool, count: int, tmp_path: Path
) -> None:
    """There are more places than a notice names."""
    with collecting():
        for place in (*range(7), *range(7)):
            note("drive.mcap", "damaged chunks, left out", f"{place} s", once=once)
        write_notices(tmp_path)
    (notice,) = read_notices(tmp_path)
    assert notice.startswith(f"drive.mcap: damaged chunks, left out: {count} (0 s; ")


def test_a_ros1_recording_in_mcap_is_the_same_as_its_bag(tmp_path: Path) -> None:
    made_bags.write_ros1(tmp_path / "drive.bag")
    made_bags.write_mcap_of_ros1(tmp_path / "drive.mcap")
    with open_bag(tmp_path / "drive.bag") as bag, open_bag(tmp_path / "drive.mcap") as mcap:
        assert mcap.topics == bag.topics
        assert counted(mcap) == counted(bag) == {name: topic.count for name, topic in bag.topics.items()}


def test_a_cut_mcap_gives_its_whole_messages_and_says_so(tmp_path: Path) -> None:
    whole, cut = tmp_path / "whole.mcap", tmp_path / "cut.mcap"
    made_bags.write_mcap_of_ros1(whole)
    content = whole.read_bytes()
    cut.write_bytes(content[: int(0.6 * len(content))])
    with open_bag(whole) as complete, open_bag(cut) as rest:
        assert {name: topic.count for name, topic in rest.topics.items()} == counted(rest)
        assert 30 < sum(counted(rest).values()) < sum(counted(complete).values())
    propose_topics(cut, topics_file(cut))
    (path,) = convert(cut, "rosbag", tmp_path / "out")
    assert 2 <= len(Log(path)) < made_bags.FRAMES
    assert "cut.mcap: the recording was cut off; " in read_notices(path.folder)[0]


@pytest.mark.parametrize("cut", [True, False])
def test_a_damaged_chunk_of_an_mcap_costs_itself_alone_and_is_named(cut: bool, tmp_path: Path) -> None:
    file = tmp_path / "drive.mcap"
    made_bags.write_mcap_of_ros1(file)
    with open_bag(file) as bag:
        complete = [(message.topic, message.recorded_s) for message in bag.read(list(bag.topics))]
    content = bytearray(file.read_bytes())
    second = content.index(b"zstd", content.index(b"zstd") + 4) + 40
    content[second : second + 8] = b"\xff" * 8
    file.write_bytes(content[:-100] if cut else content)
    with open_bag(file) as bag, collecting():
        rest = [(message.topic, message.recorded_s) for message in bag.read(list(bag.topics))]
        list(bag.read(list(bag.topics)))  # a second pass, as for images
        write_notices(tmp_path)
    lost = [row for row in complete if row not in rest]
    assert [row for row in complete if row not in lost] == rest
    assert 0 < len(lost) < 0.4 * len(complete)
    assert rest[-1][1] > lost[-1][1]
    (line,) = (line for line in read_notices(tmp_path) if "damaged" in line)
    first_s, last_s = (f"{lost[k][1]:.3f}" for k in (0, -1))
    assert line.startswith(f"drive.mcap: damaged chunks, left out: 1 (recorded at {first_s} to {last_s} s: ")


@pytest.mark.parametrize("compression", list(Writer1.CompressionFormat))
def test_a_damaged_chunk_of_a_ros1_bag_costs_itself_alone_and_is_named(
    compression: Writer1.CompressionFormat, tmp_path: Path
) -> None:
    file = tmp_path / "drive.bag"
    made_bags.write_ros1(file, compression, chunk_bytes=6000)
    with open_bag(file) as bag:
        complete = [(message.topic, message.recorded_s) for message in bag.read(list(bag.topics))]
    content = bytearray(file.read_bytes())
    third = [match.end() for match in re.finditer(b"compression=", content)][2] + 80
    content[third : third + 200] = b"\xff" * 200
    file.write_bytes(content)
    with open_bag(file) as bag, collecting():
        rest = [(message.topic, message.recorded_s) for message in bag.read(list(bag.topics))]
        list(bag.read(list(bag.topics)))  # a second pass, as for images
        write_notices(tmp_path)
    lost = [row for row in complete if row not in rest]
    assert [row for row in complete if row not in lost] == rest
    assert 0 < len(lost) < 0.4 * len(complete)
    assert rest[-1][1] > lost[-1][1]
    index, chunk = sorted(read_notices(tmp_path), key=lambda line: "chunks" in line)
    assert index.startswith("drive.bag: damaged; read on without its index: ")
    assert chunk.startswith("drive.bag: damaged chunks, left out: 1 (")


def test_a_recording_without_a_whole_chunk_is_one_line(tmp_path: Path) -> None:
    file = tmp_path / "drive.mcap"
    made_bags.write_mcap_of_ros1(file)
    propose_topics(file, topics_file(file))
    first, *others = file.read_bytes().split(b"zstd")
    chunks = len(others) // 2  # the summary names the compression of each once more
    damaged = [part[:40] + b"\xff" * 8 + part[48:] for part in others[:chunks]]
    file.write_bytes(b"zstd".join([first, *damaged, *others[chunks:]]))
    with pytest.raises(InputError, match=r": none of its messages can be read; the recording is damaged$"):
        convert(file, "rosbag", tmp_path / "out")


@pytest.mark.parametrize("name", ["drive.bag", "drive.bag.active"])
def test_a_ros1_bag_that_was_not_closed_gives_its_whole_messages(name: str, tmp_path: Path) -> None:
    made_bags.write_ros1(tmp_path / "whole.bag")
    content = (tmp_path / "whole.bag").read_bytes()
    index = content.index(b"index_pos=") + len(b"index_pos=")
    position = int.from_bytes(content[index : index + 8], "little")
    bag = tmp_path / name
    bag.write_bytes(content[:index] + bytes(8) + content[index + 8 : position - 400])
    with open_bag(tmp_path / "whole.bag") as complete, open_bag(bag) as rest:
        assert {name: topic.type for name, topic in rest.topics.items()}.items() <= {
            name: topic.type for name, topic in complete.topics.items()
        }.items()
        assert counted(rest) == {name: topic.count for name, topic in rest.topics.items()}
        assert sum(counted(rest).values()) > 30


def test_a_ros2_bag_without_metadata_is_read(tmp_path: Path) -> None:
    made_bags.write_ros2(tmp_path / "drive", StoragePlugin.MCAP)
    with open_bag(tmp_path / "drive") as bag:
        topics, counts = bag.topics, counted(bag)
    (tmp_path / "drive" / "metadata.yaml").unlink()
    (file,) = (tmp_path / "drive").iterdir()
    file.rename(tmp_path / "drive" / "drive_0.mcap")
    with open_bag(tmp_path / "drive") as bag:
        assert (bag.topics, counted(bag)) == (topics, counts)


def write_json(path: Path) -> None:
    """A pose of the vehicle, and a cloud with one point that has a pose of its own, as JSON."""
    stamp = {"sec": 1_700_000_000, "nsec": 250_000_000}
    turn = {"x": 0, "y": 0, "z": 0, "w": 1}
    field = [{"name": axis, "offset": 4 * k, "type": 7} for k, axis in enumerate("xyz")]
    point = base64.b64encode(np.array([1, 2, 3], "<f4").tobytes()).decode()
    mount = {"position": {"x": 1, "y": 0, "z": 2}, "orientation": turn}
    rows = {
        "/tf": (
            "foxglove.FrameTransform",
            {
                "timestamp": stamp,
                "parent_frame_id": "world",
                "child_frame_id": "ego",
                "translation": {"x": 4, "y": 5, "z": 6},
                "rotation": turn,
            },
        ),
        "/lidar": (
            "foxglove.PointCloud",
            {
                "timestamp": stamp,
                "frame_id": "ego",
                "pose": mount,
                "point_stride": 12,
                "fields": field,
                "data": point,
            },
        ),
        "/chatter": ("std_msgs/String", {"data": "x"}),
    }
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for topic, (name, content) in rows.items():
            schema = writer.register_schema(name, "jsonschema", b"{}")
            channel = writer.register_channel(topic, "json", schema)
            writer.add_message(channel, 1, json.dumps(content).encode(), 1)
        writer.finish()


def test_json_of_foxgloves_schemas_is_read_and_other_json_named(tmp_path: Path) -> None:
    write_json(tmp_path / "drive.mcap")
    with open_bag(tmp_path / "drive.mcap") as bag:
        contents = {message.topic: message.decode() for message in bag.read(["/tf", "/lidar"])}
        assert bag.topics["/chatter"].unread is not None
    (placed,) = read_placed(contents["/tf"])
    assert (placed.parent, placed.child, placed.t_us) == ("world", "ego", 1_700_000_000_250_000)
    assert placed.T_parent_child[:3, 3].tolist() == [4.0, 5.0, 6.0]
    assert stamp_us(contents["/lidar"]) == placed.t_us
    assert read_cloud(contents["/lidar"]).xyz_m.tolist() == [[2.0, 2.0, 5.0]]
    with pytest.raises(InputError, match=r"neither a \.bag"), open_bag(tmp_path):
        pass
