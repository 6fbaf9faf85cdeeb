"""Records of the Waymo Open Dataset by its published protocol buffers, which py123d has (with TensorFlow)."""

import importlib
import io
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

PROTOS = "py123d.parser.wod.waymo_open_dataset.protos"


def write_perception(root: Path) -> None:
    """Two frames 0.1 s and 1 m apart: a lidar of 2 × 2 pixels that sees 10 m all around, a car."""
    pb = _protos("dataset_pb2")
    records = []
    for k in range(2):
        frame = pb.Frame(timestamp_micros=1_000_000 + 100_000 * k)
        frame.context.name = "1_2_3"
        frame.context.stats.location = "location_sf"
        frame.pose.transform.extend(_moved(float(k)))
        calibration = frame.context.laser_calibrations.add(name=1)
        calibration.beam_inclinations.extend([-0.01, 0.01])
        calibration.extrinsic.transform.extend(np.eye(4).reshape(-1).tolist())
        laser = frame.lasers.add(name=1)
        image = np.zeros((2, 2, 4), np.float32)
        image[..., 0], image[..., 1] = 10.0, 0.5
        pose = np.zeros((2, 2, 6), np.float32)
        pose[..., 3] = float(k)
        laser.ri_return1.range_image_compressed = _matrix(pb.MatrixFloat(), image)
        laser.ri_return1.range_image_pose_compressed = _matrix(pb.MatrixFloat(), pose)
        laser.ri_return1.camera_projection_compressed = _matrix(
            pb.MatrixInt32(), np.zeros((2, 2, 6), np.int32)
        )
        camera = frame.context.camera_calibrations.add(name=1, width=32, height=16)
        camera.intrinsic.extend([50, 50, 16, 8, 0, 0, 0, 0, 0])
        camera.extrinsic.transform.extend(np.eye(4).reshape(-1).tolist())
        shown = frame.images.add(name=1, image=_jpeg(), pose_timestamp=1.0 + 0.1 * k)
        shown.pose.transform.extend(_moved(float(k)))
        label = frame.laser_labels.add(id="car", type=1)
        label.box.center_x, label.box.center_y, label.box.center_z = 10.0, 2.0, 0.8
        label.box.length, label.box.width, label.box.height = 4.0, 1.8, 1.6
        records.append(frame.SerializeToString())
    _write(root / "training" / "segment-1_2_3.tfrecord", records)


def write_motion(root: Path) -> None:
    """Three steps of the vehicle and one car."""
    pb = _protos("scenario_pb2")
    scenario = pb.Scenario(scenario_id="abc", sdc_track_index=0, current_time_index=1)
    scenario.timestamps_seconds.extend([0.0, 0.1, 0.2])
    size = {"length": 5.285999774932861, "width": 2.3320000171661377, "height": 2.3299999237060547}
    for track in range(2):
        added = scenario.tracks.add(id=track + 1, object_type=1)
        for k in range(3):
            added.states.add(center_x=k + 10.0 * track, center_y=0.0, center_z=1.0, valid=True, **size)
    for _ in range(3):
        scenario.dynamic_map_states.add()
    edge = scenario.map_features.add(id=1)
    edge.road_edge.type = 1
    for x in (0.0, 50.0):
        edge.road_edge.polyline.add(x=x, y=5.0, z=0.0)
    _write(root / "validation" / "validation.tfrecord-00000-of-00150", [scenario.SerializeToString()])


def _protos(name: str) -> Any:
    names = ("vector_pb2", "map_pb2", "keypoint_pb2", "label_pb2", "dataset_pb2", "camera_tokens_pb2")
    for needed in (*names, "compressed_lidar_pb2"):
        importlib.import_module(f"{PROTOS}.{needed}")
    return importlib.import_module(f"{PROTOS}.{name}")


def _moved(x_m: float) -> list[float]:
    T = np.eye(4)
    T[0, 3] = x_m
    return T.reshape(-1).tolist()


def _matrix(message: Any, values: np.ndarray) -> bytes:
    message.data.extend(values.reshape(-1).tolist())
    message.shape.dims.extend(values.shape)
    return zlib.compress(message.SerializeToString())


def _jpeg() -> bytes:
    out = io.BytesIO()
    Image.new("RGB", (32, 16), (200, 10, 30)).save(out, "JPEG")
    return out.getvalue()


def _write(file: Path, records: list[bytes]) -> None:
    import tensorflow as tf

    file.parent.mkdir(parents=True)
    with tf.io.TFRecordWriter(str(file)) as writer:
        for record in records:
            writer.write(record)
