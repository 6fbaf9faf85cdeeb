"""Messages of Foxglove's schemas (protocol buffers), converted from the types of `scene`.

Source: docs.foxglove.dev/docs/visualization/message-schemas. The package `foxglove-schemas-protobuf` has the
compiled messages. Frames: "world", "ego", and "camera/NAME" with z ahead. Pixel centres are at whole numbers
there, and at +0.5 here. Not opened in Foxglove: `docs/how-to/other-tools.md` says what was tried.
"""

import numpy as np
import torch
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.CubePrimitive_pb2 import CubePrimitive
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.TextPrimitive_pb2 import TextPrimitive
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from foxglove_schemas_protobuf.VoxelGrid_pb2 import VoxelGrid
from google.protobuf.timestamp_pb2 import Timestamp
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from foredrive.geometry.quaternions import quaternion_from_matrix
from foredrive.scene import Boxes, Category, LidarSweep, Trajectory, VoxelSpec

WORLD, EGO = "world", "ego"
RGB = tuple[int, int, int]
_POINT = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("time", "<f4"), ("ring", "<u1")]
)
_FLOAT32, _UINT8 = PackedElementField.FLOAT32, PackedElementField.UINT8
_LINE_M, _TEXT_M = 0.1, 0.8


def image_message(t_us: int, camera: str, encoded: bytes) -> CompressedImage:
    """Return an image: a JPEG or PNG."""
    kind = "png" if encoded.startswith(b"\x89PNG") else "jpeg"
    return CompressedImage(timestamp=_stamp(t_us), frame_id=camera_frame(camera), data=encoded, format=kind)


def calibration_message(
    t_us: int, camera: str, K: Float[Tensor, "3 3"], dist: Float[Tensor, "5"], size_hw: tuple[int, int]
) -> CameraCalibration:
    """Return the calibration of a camera."""
    at_whole = K.double().clone()
    # Here the middle of the first pixel is at 0.5, in Foxglove's schemas at 0
    at_whole[:2, 2] -= 0.5
    P = torch.cat([at_whole, torch.zeros(3, 1, dtype=torch.float64)], dim=1)
    return CameraCalibration(
        timestamp=_stamp(t_us),
        frame_id=camera_frame(camera),
        width=size_hw[1],
        height=size_hw[0],
        distortion_model="plumb_bob",
        D=dist.tolist(),
        K=at_whole.flatten().tolist(),
        R=np.eye(3).reshape(-1).tolist(),
        P=P.flatten().tolist(),
    )


def transform_message(t_us: int, parent: str, child: str, T: Float64[Tensor, "4 4"]) -> FrameTransform:
    """Return the pose of a frame in its parent."""
    pose = _pose(T)
    return FrameTransform(
        timestamp=_stamp(t_us),
        parent_frame_id=parent,
        child_frame_id=child,
        translation=pose.position,
        rotation=pose.orientation,
    )


def cloud_message(t_us: int, sweep: LidarSweep) -> PointCloud:
    """Return the returns of a sweep in the ego frame. The field "time" is relative to the message, s."""
    kept = sweep[sweep.valid & sweep.returned]
    cells = np.zeros(len(kept.range_m), _POINT)
    for axis, name in enumerate("xyz"):
        cells[name] = kept.points_ego[:, axis].numpy()
    cells["intensity"], cells["time"] = kept.intensity.numpy(), kept.dt_s.numpy()
    cells["ring"] = kept.beam.clamp(0, 255).numpy()
    fields = [
        PackedElementField(
            name=name, offset=_POINT.fields[name][1], type=_UINT8 if name == "ring" else _FLOAT32
        )
        for name in _POINT.names or ()
        if _POINT.fields is not None
    ]
    return PointCloud(
        timestamp=_stamp(t_us),
        frame_id=EGO,
        pose=_pose(torch.eye(4, dtype=torch.float64)),
        point_stride=_POINT.itemsize,
        fields=fields,
        data=cells.tobytes(),
    )


def boxes_message(t_us: int, boxes: Boxes, colours: list[RGB]) -> SceneUpdate:
    """Return the boxes of one frame, which replace those before.

    Args:
        t_us: time of the frame, µs.
        boxes: unbatched, in the ego frame.
        colours: of each box that is valid.
    """
    kept = boxes[boxes.valid]
    entities = []
    for row, colour in enumerate(colours):
        T = torch.eye(4, dtype=torch.float64)
        turn = float(kept.yaw[row])
        T[:2, :2] = torch.tensor([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        T[:3, 3] = kept.centre[row].double()
        name = Category(int(kept.category[row])).name.lower()
        # The label stands half a height above the roof
        above = _pose(T)
        above.position.z += float(kept.size_lwh[row, 2])
        shown = f"{name} {int(kept.track_id[row])}"
        text = TextPrimitive(
            pose=above, billboard=True, font_size=_TEXT_M, color=_colour(colour, 1.0), text=shown
        )
        cube = CubePrimitive(
            pose=_pose(T), size=_vector(kept.size_lwh[row].tolist()), color=_colour(colour, 0.35)
        )
        entities.append(
            SceneEntity(
                timestamp=_stamp(t_us),
                frame_id=EGO,
                id=str(int(kept.track_id[row])),
                cubes=[cube],
                texts=[text],
            )
        )
    return _update(t_us, entities)


def lines_message(t_us: int, lines: list[tuple[Float64[np.ndarray, "_ 3"], RGB]], name: str) -> SceneUpdate:
    """Return polylines in the world frame that stay; another message of the name replaces them."""
    strips = [
        LinePrimitive(
            type=LinePrimitive.LINE_STRIP,
            thickness=_LINE_M,
            points=[Point3(x=x, y=y, z=z) for x, y, z in vertices.tolist()],
            color=_colour(colour, 1.0),
        )
        for vertices, colour in lines
    ]
    entity = SceneEntity(timestamp=_stamp(t_us), frame_id=WORLD, id=name, lines=strips)
    return SceneUpdate(entities=[entity])


def path_message(t_us: int, path: Trajectory) -> PosesInFrame:
    """Return the first alternative of a trajectory in the ego frame, as far as it is valid."""
    kept = path.valid[0]
    poses = []
    for (x, y), yaw in zip(path.xy[0][kept].tolist(), path.yaw[0][kept].tolist(), strict=True):
        half = 0.5 * yaw
        turn = Quaternion(x=0.0, y=0.0, z=float(np.sin(half)), w=float(np.cos(half)))
        poses.append(Pose(position=Vector3(x=x, y=y, z=0.0), orientation=turn))
    return PosesInFrame(timestamp=_stamp(t_us), frame_id=EGO, poses=poses)


def voxels_message(t_us: int, occupied: Bool[Tensor, "Z Y X"], spec: VoxelSpec, colour: RGB) -> VoxelGrid:
    """Return occupied voxels in the ego frame; free ones are transparent."""
    # The pose of the grid is that of its lower corner, not of the middle of a voxel
    corner = torch.eye(4, dtype=torch.float64)
    corner[:3, 3] = torch.tensor(spec.lower_m)
    cells = np.zeros((*occupied.shape, 4), np.uint8)
    cells[occupied.numpy()] = (*colour, 200)
    rows, columns = occupied.shape[1:]
    names = ("red", "green", "blue", "alpha")
    return VoxelGrid(
        timestamp=_stamp(t_us),
        frame_id=EGO,
        pose=_pose(corner),
        row_count=rows,
        column_count=columns,
        cell_size=_vector([spec.voxel_m] * 3),
        slice_stride=4 * rows * columns,
        row_stride=4 * columns,
        cell_stride=4,
        fields=[PackedElementField(name=name, offset=k, type=_UINT8) for k, name in enumerate(names)],
        data=cells.tobytes(),
    )


def camera_frame(camera: str) -> str:
    """Return the name of a camera's frame."""
    return f"camera/{camera}"


def _update(t_us: int, entities: list[SceneEntity]) -> SceneUpdate:
    # All earlier entities of the topic are deleted
    deletion = SceneEntityDeletion(timestamp=_stamp(t_us), type=SceneEntityDeletion.ALL)
    return SceneUpdate(deletions=[deletion], entities=entities)


def _stamp(t_us: int) -> Timestamp:
    return Timestamp(seconds=t_us // 1_000_000, nanos=t_us % 1_000_000 * 1000)


def _pose(T: Float64[Tensor, "4 4"]) -> Pose:
    w, x, y, z = quaternion_from_matrix(T[:3, :3]).tolist()
    return Pose(position=_vector(T[:3, 3].tolist()), orientation=Quaternion(x=x, y=y, z=z, w=w))


def _vector(xyz: list[float]) -> Vector3:
    return Vector3(x=xyz[0], y=xyz[1], z=xyz[2])


def _colour(rgb: RGB, alpha: float) -> Color:
    red, green, blue = (value / 255 for value in rgb)
    return Color(r=red, g=green, b=blue, a=alpha)
