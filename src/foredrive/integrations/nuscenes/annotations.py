"""Boxes of a log as nuScenes' instances and annotations."""

import numpy as np
from jaxtyping import Float64

from foredrive.data.boxes import box_row, read_boxes, read_tracks
from foredrive.data.formats.nuscenes_names import NAME_OF_CATEGORY
from foredrive.data.logs import Log
from foredrive.integrations.nuscenes.tables import (
    Row,
    attribute_token,
    category_token,
    link,
    pose,
    token,
    visibility_token,
)
from foredrive.scene import Attribute, Category, LidarSweep, Visibility
from foredrive.scene.boxes import UNKNOWN


def annotations_at(
    log: Log, frame: int, sample_token: str, sweep: LidarSweep | None
) -> list[tuple[int, Category, Row]]:
    """Return track, category and annotation of the boxes at a frame, without those of their neighbours.

    Boxes are as logged, in all three axes of rotation. The number of lidar points is as logged too, else that
    of the sweep's returns in the box. What the log does not tell of attribute and visibility is left empty.
    """
    tracks, boxes, row = read_tracks(log), read_boxes(log, frame), box_row(log, frame)
    if tracks is None or boxes is None or row is None:
        return []
    points_world = _points_world(sweep, log.T_world_ego[frame])
    all_rows = np.arange(tracks.first_row[row], tracks.first_row[row + 1])
    annotations = []
    for index, box in enumerate(all_rows[tracks.is_object[all_rows]].tolist()):
        labels = (boxes.track_id, boxes.attribute, boxes.visibility, boxes.num_points)
        track, attribute, level, points = (int(values[index]) for values in labels)
        length, width, height = tracks.size_lwh[box].tolist()
        T_world_box = np.eye(4)
        T_world_box[:3, :3], T_world_box[:3, 3] = tracks.R_world_box[box], tracks.centre[box]
        if points == UNKNOWN:
            points = _count_inside(points_world, T_world_box, tracks.size_lwh[box])
        annotation = {
            "token": token("sample_annotation", sample_token, track),
            "sample_token": sample_token,
            "instance_token": token("instance", log.path.name, track),
            "visibility_token": "" if level == UNKNOWN else visibility_token(Visibility(level)),
            "attribute_tokens": [] if attribute == UNKNOWN else [attribute_token(Attribute(attribute))],
            **pose(T_world_box),
            "size": [width, length, height],
            "num_lidar_pts": points,
            "num_radar_pts": 0,
        }
        annotations.append((track, Category(int(boxes.category[index])), annotation))
    return annotations


def _points_world(sweep: LidarSweep | None, T_world_ego: Float64[np.ndarray, "4 4"]) -> np.ndarray:
    """Return the returns of a sweep in the world frame, [N 3]; none without a sweep."""
    if sweep is None:
        return np.zeros((0, 3))
    points = sweep[sweep.valid & sweep.returned].points_ego.double().numpy()
    in_world: np.ndarray = points @ T_world_ego[:3, :3].T + T_world_ego[:3, 3]
    return in_world


def _count_inside(
    points: Float64[np.ndarray, "N 3"],
    T_world_box: Float64[np.ndarray, "4 4"],
    size: Float64[np.ndarray, "3"],
) -> int:
    """Return the number of points in a box, each box for itself, as the devkit's `points_in_box` counts."""
    offset = points - T_world_box[:3, 3]
    offset = offset[np.einsum("nk,nk->n", offset, offset) <= 0.25 * size @ size]
    return int((np.abs(offset @ T_world_box[:3, :3]) <= 0.5 * size).all(-1).sum())


def instances_of(log: Log, keyed: list[tuple[int, Category, Row]]) -> list[Row]:
    """Return the table `instance` of all annotations, in order of time, and link those of each instance.

    An instance has the category of its first annotation.
    """
    of_track: dict[int, list[Row]] = {}
    category: dict[int, Category] = {}
    for track, kind, annotation in keyed:
        of_track.setdefault(track, []).append(annotation)
        category.setdefault(track, kind)
    for annotations in of_track.values():
        link(annotations)
    return [
        {
            "token": token("instance", log.path.name, track),
            "category_token": category_token(NAME_OF_CATEGORY[category[track]]),
            "nbr_annotations": len(annotations),
            "first_annotation_token": annotations[0]["token"],
            "last_annotation_token": annotations[-1]["token"],
        }
        for track, annotations in of_track.items()
    ]
