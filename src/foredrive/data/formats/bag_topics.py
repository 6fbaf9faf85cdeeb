"""The YAML that says which topics of a bag are cameras, lidar and poses."""

import math
from pathlib import Path
from typing import Literal

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    FiniteFloat,
    PositiveFloat,
    TypeAdapter,
    ValidationError,
    field_validator,
    model_validator,
)

from foredrive.data.formats.bag_images import is_rectified
from foredrive.errors import InputError
from foredrive.plain_yaml import read_yaml


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Intrinsics(_Strict):
    """Calibration of a camera as a CameraInfo has it: px, pixel centres at whole numbers."""

    fx: PositiveFloat
    fy: PositiveFloat
    cx: FiniteFloat
    cy: FiniteFloat
    distortion: tuple[FiniteFloat, ...] = Field((), max_length=5)
    """OpenCV's k1 k2 p1 p2 k3."""


class Mount(_Strict):
    """Pose of a sensor's frame in `ego_frame`, for bags whose transforms lack it."""

    position_m: tuple[FiniteFloat, FiniteFloat, FiniteFloat]
    quaternion_wxyz: tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]

    @field_validator("quaternion_wxyz")
    @classmethod
    def _is_rotation(cls, quaternion: tuple[float, ...]) -> tuple[float, ...]:
        if not 0.9 < math.hypot(*quaternion) < 1.1:
            raise ValueError("a rotation is a quaternion of length 1")
        return quaternion


class CameraTopics(_Strict):
    """The topics of one camera."""

    images: str
    info: str | None = None
    """Topic of its CameraInfo. None: `intrinsics` are given."""
    intrinsics: Intrinsics | None = None
    frame: str | None = None
    """The optical frame: x to the right, y down, z ahead. None: as the images say."""
    mount: Mount | None = None
    """Pose of the optical frame. None: as the transforms say."""
    value_range: tuple[FiniteFloat, FiniteFloat] | None = None
    """Values of images of 16 bits that become 0 and 255."""
    rectified: bool | None = None
    """Whether the images are rectified, so that P and R of `info` hold and not K and D. None: as the name of
    their topic says."""

    @model_validator(mode="after")
    def _has_calibration(self) -> "CameraTopics":
        if (self.info is None) == (self.intrinsics is None):
            raise ValueError("a camera needs either the topic `info` or its `intrinsics`")
        return self


class LidarTopic(_Strict):
    """The topic of the lidar."""

    topic: str
    intensity_max: PositiveFloat = 255.0
    """Stored intensity that is 1."""
    point_times: Literal["s", "ms", "us", "ns", "none"] | None = None
    """Unit of the points' times, absolute or since the message's stamp; "none": they are not used. None: the
    unit that fits."""
    compensated: bool = False
    """True if the driver of the lidar has removed the vehicle's motion within a sweep."""
    frame: str | None = None
    mount: Mount | None = None
    """Pose of the lidar's frame. None: as the transforms say."""


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
        return TypeAdapter(BagTopics).validate_python(read_yaml(file))
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise InputError(f"{file}: {place or 'the file'}: {first['msg']}") from error


def is_rectified_camera(camera: CameraTopics) -> bool:
    """Return whether the images of a camera are rectified, as the YAML says, else the name of their topic."""
    return is_rectified(camera.images) if camera.rectified is None else camera.rectified
