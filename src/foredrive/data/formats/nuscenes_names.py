"""nuScenes' names of cameras and categories. They are those of py123d's tables for reading nuScenes."""

import json
from pathlib import Path
from typing import Any

from py123d.datatypes import CameraID, PinholeCameraMetadata
from py123d.parser.nuscenes.utils.nuscenes_constants import NUSCENES_CAMERA_IDS, NUSCENES_DETECTION_NAME_DICT

from foredrive.data.written_boxes import LABEL_OF_CATEGORY
from foredrive.errors import InputError
from foredrive.scene import Category

_NAME_OF_LABEL = {label: name for name, label in NUSCENES_DETECTION_NAME_DICT.items()}
_OTHER_CAMERA = "CAM_"
_PINHOLE = "PCAM_"

CATEGORY_NAMES = tuple(sorted(NUSCENES_DETECTION_NAME_DICT))
"""All categories of nuScenes."""
NAME_OF_CATEGORY: dict[Category, str] = {
    category: _NAME_OF_LABEL[label] for category, label in LABEL_OF_CATEGORY.items()
}


def camera_channel(camera: PinholeCameraMetadata) -> str:
    """Return the channel of a camera: nuScenes' own at its six places, else one of 123D's name.

    123D's PCAM_F0, B0, L0, R0, L1 and R1 are CAM_FRONT, CAM_BACK, CAM_FRONT_LEFT, …, CAM_BACK_RIGHT. Another
    camera, such as PCAM_L2, is CAM_L2.
    """
    channels: dict[CameraID, str] = NUSCENES_CAMERA_IDS
    return channels.get(camera.camera_id, _OTHER_CAMERA + camera.camera_id.name.removeprefix(_PINHOLE))


def camera_of_channel(channel: str) -> CameraID | None:
    """Return the camera of a channel, the inverse of `camera_channel`. None if 123D has none of this name."""
    own = {name: camera for camera, name in NUSCENES_CAMERA_IDS.items()}
    named: CameraID | None = CameraID.__members__.get(_PINHOLE + channel.removeprefix(_OTHER_CAMERA))
    return own.get(channel, named)


def read_table(file: Path) -> dict[str, dict[str, Any]]:
    """Read a table of nuScenes by the token of its rows.

    Raises:
        InputError: the file cannot be read, or is not a table.
    """
    try:
        rows = json.loads(file.read_bytes())  # bytes may begin with a byte order mark
        if not isinstance(rows, list):
            raise TypeError("not a list of rows")
        return {row["token"]: row for row in rows}
    except OSError as error:
        raise InputError(f"{file}: {error.strerror or error}") from error
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise InputError(f"{file}: not a table of nuScenes") from error
