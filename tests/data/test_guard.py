"""Reading of parts: damaged bytes cost themselves, whatever a decoder raises; mistakes in code are raised."""

import functools
import gzip
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import raw_av2
import raw_pandaset
from made_bags import Messages
from PIL import Image
from py123d.parser.base_dataset_parser import ParsedLidar

from foredrive.data.formats.convert import DATASETS
from foredrive.data.formats.guard import PartReader, SensorFiles
from foredrive.data.images import read_rgb
from foredrive.data.notices import collecting
from foredrive.data.safe_pickle import load_table
from foredrive.errors import InputError


@pytest.mark.parametrize("mistake", [TypeError, AttributeError, NameError, UnboundLocalError, ImportError])
def test_a_mistake_in_code_is_no_damage(mistake: type[Exception]) -> None:
    def read() -> None:
        raise mistake

    with collecting(), pytest.raises(mistake):
        PartReader("lidar", "sweeps")("0", read)


def image(kind: str, folder: Path) -> tuple[Callable[[bytes], object], bytes]:
    pixels = np.random.default_rng(0).integers(0, 255, (24, 40, 3), np.uint8)
    file = folder / f"image.{kind}"
    Image.fromarray(pixels).save(file)

    def read(content: bytes) -> object:
        file.write_bytes(content)
        return read_rgb(file)

    return read, file.read_bytes()


def sweep(folder: Path) -> tuple[Callable[[bytes], object], bytes]:
    raw_av2.write(folder / "val" / "0-1")
    (log,) = DATASETS["av2"].find(folder)
    frame = next(iter(log.log.iter_modalities_sync()))
    (parsed,) = (one for one in frame.modalities if isinstance(one, ParsedLidar))
    file = sorted((folder / "val" / "0-1" / "sensors" / "lidar").iterdir())[0]
    good = file.read_bytes()

    def read(content: bytes) -> object:
        file.write_bytes(content)
        return SensorFiles(folder, "av2-sensor")._sweep(parsed)

    return read, good


def table(folder: Path) -> tuple[Callable[[bytes], object], bytes]:
    raw_pandaset.write(folder / "log")
    file = folder / "log" / raw_pandaset.LIDAR
    good = gzip.decompress(file.read_bytes())

    def read(content: bytes) -> object:
        file.write_bytes(gzip.compress(content, 1))
        return load_table(file)

    return read, good


def message(version: int, _: Path) -> tuple[Callable[[bytes], object], bytes]:
    made = Messages(version)
    _, _, first = next(iter(each for each in made.recording() if "Image" in each[2].__msgtype__))
    store, kind = made.store, first.__msgtype__
    if version == 1:
        return lambda content: store.deserialize_ros1(content, kind), bytes(store.serialize_ros1(first, kind))
    return lambda content: store.deserialize_cdr(content, kind), bytes(store.serialize_cdr(first, kind))


def damaged(good: bytes, rng: random.Random) -> bytes:
    """Cut the bytes, insert some, or change up to thirty, mostly near the start."""
    content, kind = bytearray(good), rng.random()
    place = rng.randrange(len(content))
    if kind < 0.3:
        return bytes(content[:place])
    if kind < 0.5:
        return bytes(content[:place] + rng.randbytes(rng.randrange(1, 20)) + content[place:])
    for _ in range(rng.choice([1, 2, 5, 30])):
        content[rng.randrange(min(len(content), rng.choice([40, 400, len(content)])))] = rng.randrange(256)
    return bytes(content)


@pytest.mark.parametrize(
    "made",
    [
        *(functools.partial(image, kind) for kind in ("png", "jpg", "webp")),
        sweep,
        table,
        *(functools.partial(message, version) for version in (1, 2)),
    ],
    ids=["png", "jpg", "webp", "feather", "pickle", "ros1", "ros2"],
)
def test_what_decoders_raise_for_damaged_bytes_is_damage(made: Callable[[Path], Any], tmp_path: Path) -> None:
    """Two hundred damages of each format: read as something, or left out; all left out is refused."""
    decode, good = made(tmp_path)
    rng, reader = random.Random(0), PartReader("sensor", "parts")
    with collecting():
        read = [reader(str(n), functools.partial(decode, damaged(good, rng))) for n in range(200)]
        assert sum(part is None for part in read) > 50
        assert reader("good", functools.partial(decode, good)) is not None
        none = PartReader("sensor", "parts")
        assert none("cut", functools.partial(decode, good[: len(good) // 3])) is None
        with pytest.raises(InputError, match="sensor: none of its parts can be read; cut: "):
            none.check()


def test_a_table_without_content_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "table.pkl.gz"
    empty = b"\x80\x04cpandas.core.frame\nDataFrame\n)\x81."  # made, but never filled
    with gzip.open(file, "wb") as written:
        written.write(empty)
    with pytest.raises(InputError, match="a table without content"):
        load_table(file)
