"""Boxes as 123D logs store them, with nuScenes labels."""

import numpy as np
from jaxtyping import Float64
from py123d.datatypes import BoxDetectionAttributes, BoxDetectionSE3, BoxDetectionsSE3, Timestamp
from py123d.datatypes.detections.box_detections_metadata import BoxDetectionsSE3Metadata
from py123d.datatypes.modalities.base_modality import BaseModality
from py123d.geometry import BoundingBoxSE3, PoseSE3, Vector3D
from py123d.geometry.utils.rotation_utils import get_quaternion_array_from_rotation_matrices
from py123d.parser.registry import NuScenesBoxDetectionLabel as Label

from foredrive.data.modalities import attributes_modality
from foredrive.geometry.se3 import matrix_from_yaw
from foredrive.scene import Boxes, Category
from foredrive.scene.boxes import UNKNOWN

LABEL_OF_CATEGORY = {
    Category.CAR: Label.VEHICLE_CAR,
    Category.TRUCK: Label.VEHICLE_TRUCK,
    Category.BUS: Label.VEHICLE_BUS_RIGID,
    Category.TRAILER: Label.VEHICLE_TRAILER,
    Category.CONSTRUCTION_VEHICLE: Label.VEHICLE_CONSTRUCTION,
    Category.MOTORCYCLE: Label.VEHICLE_MOTORCYCLE,
    Category.BICYCLE: Label.VEHICLE_BICYCLE,
    Category.PEDESTRIAN: Label.HUMAN_PEDESTRIAN_ADULT,
    Category.ANIMAL: Label.ANIMAL,
    Category.TRAFFIC_CONE: Label.MOVABLE_OBJECT_TRAFFICCONE,
    Category.BARRIER: Label.MOVABLE_OBJECT_BARRIER,
    Category.OTHER: Label.MOVABLE_OBJECT_DEBRIS,
}
"""nuScenes labels. They distinguish all categories, and py123d can read them without Foredrive."""


def box_modalities(boxes: Boxes, T_world_ego: Float64[np.ndarray, "4 4"], t_us: int) -> list[BaseModality]:
    """Return the valid boxes of a frame, and their attributes if any is known, as 123D stores them.

    Args:
        boxes: unbatched, in the ego frame.
        T_world_ego: ego pose at the time of the boxes.
        t_us: that time, µs.
    """
    R_world_ego = T_world_ego[:3, :3]
    boxes = boxes[boxes.valid]
    points = [None if count == UNKNOWN else count for count in boxes.num_points.tolist()]
    T_ego_box = matrix_from_yaw(boxes.yaw.double(), boxes.centre.double()).numpy()
    detections = []
    T_world_box = T_world_ego @ T_ego_box
    # py123d's conversion of one matrix at a time would take most of the time of writing a log
    quaternions = get_quaternion_array_from_rotation_matrices(T_world_box[:, :3, :3])
    for pose, size, velocity, track, category, hits in zip(
        np.concatenate([T_world_box[:, :3, 3], quaternions], axis=1),
        boxes.size_lwh.tolist(),
        boxes.velocity.double().numpy(),
        boxes.track_id.tolist(),
        boxes.category.tolist(),
        points,
        strict=True,
    ):
        known = np.isfinite(velocity).all()
        over_ground = Vector3D.from_array(R_world_ego @ [*velocity, 0.0]) if known else None
        attributes = BoxDetectionAttributes(LABEL_OF_CATEGORY[Category(category)], str(track), hits)
        detections.append(
            BoxDetectionSE3(attributes, BoundingBoxSE3(PoseSE3.from_array(pose), *size), over_ground)
        )
    when, attribute = Timestamp.from_us(t_us), boxes.attribute.tolist()
    written: list[BaseModality] = [BoxDetectionsSE3(detections, when, BoxDetectionsSE3Metadata(Label))]
    if any(known != UNKNOWN for known in attribute):
        written.append(attributes_modality(attribute, when))
    return written
