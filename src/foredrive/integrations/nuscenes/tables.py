"""Rows of nuScenes' tables: tokens, poses, lists of neighbours, and the tables that all logs share.

Source: nuscenes-devkit 1.2.0, docs/schema_nuscenes.md.
"""

import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from foredrive.data.formats.nuscenes_names import CATEGORY_NAMES
from foredrive.scene import Attribute, Visibility

Row = dict[str, Any]

TABLES_OF_A_LOG = (
    "log",
    "map",
    "scene",
    "sample",
    "sensor",
    "calibrated_sensor",
    "ego_pose",
    "sample_data",
    "instance",
    "sample_annotation",
)


def token(*names: object) -> str:
    """Return the token of something by its names. It has 32 hexadecimal digits, as nuScenes' tokens have."""
    return hashlib.blake2b("\0".join(map(str, names)).encode(), digest_size=16).hexdigest()


def pose(T: Float64[np.ndarray, "4 4"]) -> Row:
    """Return a pose as nuScenes writes it: m, and a quaternion w x y z."""
    turn = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True, scalar_first=True)
    return {"translation": T[:3, 3].tolist(), "rotation": turn.tolist()}


def link(rows: Sequence[Row]) -> None:
    """Write into rows, which are in order, the tokens of their neighbours. The ends have empty ones."""
    tokens = ["", *(row["token"] for row in rows), ""]
    for row, before, after in zip(rows, tokens, tokens[2:], strict=False):
        row["prev"], row["next"] = before, after


def shared_tables() -> dict[str, list[Row]]:
    """Return the tables that are the same in every data set."""
    return {
        "category": [
            {"token": category_token(name), "name": name, "description": ""} for name in CATEGORY_NAMES
        ],
        "attribute": [
            {"token": attribute_token(attribute), "name": attribute.label, "description": ""}
            for attribute in Attribute
        ],
        "visibility": [
            {
                "token": visibility_token(level),
                "level": level.name.lower().replace("_", "-"),
                "description": "share of the object that is visible in all images together, %",
            }
            for level in Visibility
        ],
    }


def category_token(name: str) -> str:
    """Return the token of a category."""
    return token("category", name)


def attribute_token(attribute: Attribute) -> str:
    """Return the token of an attribute."""
    return token("attribute", attribute.label)


def visibility_token(level: Visibility) -> str:
    """Return the token of a level. Tokens of levels are their numbers in nuScenes too."""
    return str(int(level))
