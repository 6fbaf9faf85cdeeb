"""py123d's PandaSet parser, with a safe reader of its pickle files, and with the attributes of cuboids.

Raw PandaSet stores sweeps, cuboids and semantic labels as gzipped pickles of tables. py123d opens all of them
with one unrestricted unpickling function. Converting a log, or opening one that refers to raw sweeps, could
thus run any code in the files. This module replaces that function for all of py123d.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from py123d.datatypes import BoxDetectionsSE3
from py123d.parser.base_dataset_parser import ModalitiesSync
from py123d.parser.pandaset import pandaset_parser, pandaset_sensor_io
from py123d.parser.pandaset.pandaset_parser import PandasetLogParser
from pydantic import FiniteFloat, TypeAdapter, ValidationError

from foredrive.data.modalities import attributes_modality
from foredrive.data.safe_pickle import load_table
from foredrive.errors import InputError
from foredrive.scene import Attribute
from foredrive.scene.boxes import UNKNOWN

pandaset_parser.read_pkl_gz = load_table
pandaset_sensor_io.read_pkl_gz = load_table

_ATTRIBUTE_OF_VALUE = {
    "attributes.rider_status": {
        "With Rider": Attribute.CYCLE_WITH_RIDER,
        "Without Rider": Attribute.CYCLE_WITHOUT_RIDER,
    },
    "attributes.pedestrian_behavior": {
        "Walking": Attribute.PEDESTRIAN_MOVING,
        "Standing": Attribute.PEDESTRIAN_STANDING,
        "Sitting": Attribute.PEDESTRIAN_SITTING_LYING_DOWN,
        "Lying": Attribute.PEDESTRIAN_SITTING_LYING_DOWN,
    },
    "attributes.object_motion": {
        "Moving": Attribute.VEHICLE_MOVING,
        "Stopped": Attribute.VEHICLE_STOPPED,
        "Parked": Attribute.VEHICLE_PARKED,
    },
}
"""nuScenes' attributes of the values in PandaSet's columns. Two-wheelers also have a motion, so the columns
are asked in this order."""


@dataclass(frozen=True)
class _Pose:
    position: dict[Literal["x", "y", "z"], FiniteFloat]
    heading: dict[Literal["w", "x", "y", "z"], FiniteFloat]


_SCHEMAS = {
    "timestamps.json": TypeAdapter(list[FiniteFloat]),
    "poses.json": TypeAdapter(list[_Pose]),
    "intrinsics.json": TypeAdapter(dict[Literal["fx", "fy", "cx", "cy"], FiniteFloat]),
}
"""Types of the JSON files of a log."""


class PandasetParser(PandasetLogParser):
    """py123d's parser, with an `Attribute` for each box."""

    def _iter_modalities_sync_from_path(self, source_log_path: Path) -> Iterator[ModalitiesSync]:
        for file in sorted([*source_log_path.glob("meta/*.json"), *source_log_path.glob("camera/*/*.json")]):
            if file.name in _SCHEMAS:
                _check_json(file, _SCHEMAS[file.name])
        for frame, sync in enumerate(super()._iter_modalities_sync_from_path(source_log_path)):
            boxes = next((found for found in sync.modalities if isinstance(found, BoxDetectionsSE3)), None)
            cuboids = source_log_path / "annotations" / "cuboids" / f"{frame:02d}.pkl.gz"
            if boxes is not None and cuboids.is_file():
                of_uuid = _attributes(cuboids)
                row = [of_uuid[box.attributes.track_token] for box in boxes.box_detections]
                sync.modalities.append(attributes_modality(row, sync.timestamp))
            yield sync


def _check_json(file: Path, schema: Any) -> None:
    """Check a file before py123d reads it. Its errors come later, without the file's name."""
    try:
        schema.validate_json(file.read_bytes())
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        raise InputError(f"{file}: {f'{where}: ' if where else ''}{first['msg']}") from error


def _attributes(cuboids: Path) -> dict[str, int]:
    """Return the attribute of each cuboid by its uuid."""
    table = load_table(cuboids)
    found = dict.fromkeys(table["uuid"].tolist(), UNKNOWN)
    for column, attribute_of in _ATTRIBUTE_OF_VALUE.items():
        values = table[column].tolist() if column in table.columns else []
        for uuid, value in zip(table["uuid"].tolist(), values, strict=False):
            if found[uuid] == UNKNOWN and value in attribute_of:
                found[uuid] = attribute_of[value]
    return found
