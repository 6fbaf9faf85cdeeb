"""Small files of detections in each format."""

import json
import math
from pathlib import Path
from typing import Any


def box(x: float, y: float, name: str = "car", yaw: float = 0.0, **more: Any) -> dict[str, Any]:
    """A box of 4 x 2 x 1.5 m in nuScenes' format."""
    return {
        "translation": [x, y, 1.0],
        "size": [2.0, 4.0, 1.5],
        "rotation": [math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)],
        "detection_name": name,
        **more,
    }


def write_nuscenes(path: Path, frames: dict[str, list[dict[str, Any]]]) -> Path:
    path.write_text(json.dumps({"meta": {}, "results": frames}))
    return path


def write_coco_truth(path: Path, annotations: list[dict[str, Any]]) -> Path:
    content = {
        "images": [{"id": n, "file_name": f"{n}.jpg", "width": 200, "height": 100} for n in (1, 2)],
        "categories": [{"id": 3, "name": "car"}, {"id": 7, "name": "dog"}],
        "annotations": annotations,
    }
    path.write_text(json.dumps(content))
    return path


def write_list(path: Path, records: list[Any]) -> Path:
    path.write_text(json.dumps(records))
    return path
