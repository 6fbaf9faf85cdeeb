"""Embedding of log frames into rows of an index: one row per sector and one per whole scene."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.data.batches import stack_records
from foredrive.data.boxes import read_boxes
from foredrive.data.cameras import CameraFrame, pinhole_cameras, read_camera
from foredrive.data.lidar import read_sweep
from foredrive.data.logs import Log
from foredrive.data.recorded import read_caption, read_setting
from foredrive.debugging import profile_step
from foredrive.scene import Category, LidarSweep
from foredrive.search.crops import Crop
from foredrive.search.rows import COUNTS, FACTS, SCORES, WHOLE, row_schema
from foredrive.search.sectors import Sector, blind_sectors, cut_camera
from foredrive.search.towers import Towers, unit

FRAMES_AT_ONCE = 8
"""Number of frames read and embedded together. It limits memory for logs of any length."""
_SMALLEST = 1e-12


@dataclass(frozen=True)
class View:
    """One sector at one moment, with its image and sweep."""

    sector: Sector
    image: Tensor | None
    sweep: LidarSweep | None

    @classmethod
    def of_camera(cls, camera: CameraFrame, sweep: LidarSweep | None) -> "View":
        """Return a camera's image, and the returns of an unbatched sweep that lie in it."""
        assert camera.image is not None
        height, width = camera.image.shape[-2:]
        sector = Sector.of_camera(camera, (height, width))
        return cls(sector, camera.image, None if sweep is None else sector.sweep(sweep))


def embed_frames(log: Log, frames: Sequence[int], towers: Towers) -> pa.Table:
    """Return the rows of frames, sorted by frame. In each frame the row of the whole scene comes first.

    Raises:
        InputError: data cannot be read.
    """
    parts = [
        _embed_few(log, frames[start : start + FRAMES_AT_ONCE], towers)
        for start in range(0, len(frames), FRAMES_AT_ONCE)
    ]
    return pa.concat_tables(parts)


def _embed_few(log: Log, frames: Sequence[int], towers: Towers) -> pa.Table:
    seen = [
        read_views(log, frame, towers.image_side_px, towers.crop, with_lidar=towers.has_lidar)
        for frame in frames
    ]
    vectors = _embed_by_name(towers, seen)
    rows: list[dict[str, object]] = []
    by_image, by_lidar = [], []
    for now, (frame, views) in enumerate(zip(frames, seen, strict=True)):
        facts, counts = _facts(log, frame), _counts(log, frame, views)
        # Axes: view, then image and lidar, then embedding
        embedded = np.array([vectors[now, name] for name in views], np.float32).reshape(-1, 2, towers.dim)
        # The embedding of the whole scene is the mean direction of its views
        for name, (image, lidar) in zip((WHOLE, *views), [mean_direction(embedded), *embedded], strict=True):
            azimuth = None if name == WHOLE else math.degrees(views[name].sector.azimuth_rad)
            rows.append({**facts, "view": name, "azimuth_deg": azimuth, **counts[name]})
            by_image.append(image)
            by_lidar.append(lidar)
    image, lidar = np.stack(by_image), np.stack(by_lidar)
    embeddings = {"image": image, "lidar": lidar, "joint": mean_direction(np.stack([image, lidar]))}
    table = pa.Table.from_pylist(rows, schema=FACTS)
    for name, values in embeddings.items():
        table = table.append_column(row_schema(towers.dim).field(name), _vector_column(values))
    return table


def _embed_by_name(
    towers: Towers, seen: Sequence[Mapping[str, View]]
) -> dict[tuple[int, str], Float[np.ndarray, "2 D"]]:
    """Return image and lidar unit vectors by moment and view. Views of one name are embedded together.

    Cameras are embedded one by one, because their image sizes differ.
    """
    vectors: dict[tuple[int, str], np.ndarray] = {}
    for name in {name for views in seen for name in views}:
        profile_step()
        moments = [now for now, views in enumerate(seen) if name in views]
        embedded = embed_views(towers, [seen[now][name] for now in moments])
        vectors |= {(now, name): pair for now, pair in zip(moments, embedded, strict=True)}
    return vectors


def read_views(log: Log, frame: int, side_px: int, crop: Crop, *, with_lidar: bool) -> dict[str, View]:
    """Read all sectors of a moment by name.

    They are the sectors of cameras with an image, or four sectors around the vehicle if there is none. Image,
    sweep and sector of a camera are cut to one crop.

    Args:
        side_px: length of the shorter side of a whole image.
    """
    lidar = read_sweep(log, frame) if with_lidar else None
    sweep = None if lidar is None else lidar[0][lidar[0].valid & lidar[0].returned]
    views = {}
    for name, metadata in pinhole_cameras(log).items():
        # The shorter side of the whole image gets the length that the tower expects
        scale = side_px / min(metadata.height, metadata.width)
        size_hw = (round(metadata.height * scale), round(metadata.width * scale))
        camera = read_camera(log, frame, metadata, size_hw, with_image=True)
        if camera.image is not None:
            views[name] = View.of_camera(cut_camera(camera, crop.box_px(size_hw)), sweep)
    if not views and sweep is not None:
        views = {name: View(sector, None, sector.sweep(sweep)) for name, sector in blind_sectors().items()}
    return views


def embed_views(towers: Towers, views: Sequence[View]) -> Float[np.ndarray, "n 2 D"]:
    """Return image and lidar unit vectors of views with one image size. NaN where the input is missing."""
    out = np.full((len(views), 2, towers.dim), np.nan, dtype=np.float32)
    images = [(n, view.image) for n, view in enumerate(views) if view.image is not None]
    # Empty sweeps have no embedding
    sweeps = [(n, v.sweep) for n, v in enumerate(views) if v.sweep is not None and len(v.sweep.valid)]
    with torch.no_grad():
        if images:
            embedded = towers.embed_images(torch.stack([image for _, image in images]))
            out[[n for n, _ in images], 0] = unit(embedded).numpy()
        sweep_vectors = towers.embed_sweeps(stack_records([sweep for _, sweep in sweeps])) if sweeps else None
        if sweep_vectors is not None:
            out[[n for n, _ in sweeps], 1] = unit(sweep_vectors).numpy()
    return out


def mean_direction(vectors: Float[np.ndarray, "n *m D"]) -> Float[np.ndarray, "*m D"]:
    """Return the normalised sum of unit vectors over n. NaN vectors are left out; NaN if all are NaN."""
    # `nansum` gives 0 where all are NaN, so these are set to NaN again
    total = np.nansum(vectors, axis=0)
    total /= np.linalg.norm(total, axis=-1, keepdims=True).clip(min=_SMALLEST)
    return np.where(np.isnan(vectors).any(-1).all(0)[..., None], np.float32(np.nan), total)


def _vector_column(vectors: Float[np.ndarray, "n D"]) -> pa.FixedSizeListArray:
    """Return vectors as an Arrow column. NaN vectors become null."""
    missing = np.isnan(vectors).any(-1)
    # The mask marks whole vectors as null; their values are zeros
    flat = pa.array(np.where(missing[:, None], 0, vectors).astype(np.float32).reshape(-1))
    return pa.FixedSizeListArray.from_arrays(flat, vectors.shape[-1], mask=pa.array(missing))


def _facts(log: Log, frame: int) -> dict[str, object]:
    setting = read_setting(log, frame)
    speed = float(log.speed_mps[frame])
    return {
        "key": f"{log.path.name}@{log.t_us[frame]}",
        "log": log.path.name,
        "folder": str(log.path.folder),
        "maps_dir": str(log.path.maps_dir),
        "frame": frame,
        "t_us": int(log.t_us[frame]),
        "t_s": float(log.t_us[frame] - log.t_us[0]) * 1e-6,
        "dataset": log.metadata.dataset,
        "place": log.metadata.location,
        "ego_speed": speed if np.isfinite(speed) else None,
        "time_of_day": None if setting is None else setting.time_of_day.value,
        "weather": None if setting is None else setting.weather.value,
        "caption": read_caption(log, frame),
        **{f"score_{name}": None for name in SCORES},
    }


def _counts(log: Log, frame: int, views: Mapping[str, View]) -> dict[str, dict[str, int | None]]:
    """Count annotated objects by class, for the whole scene and each view. None if not annotated."""
    boxes = read_boxes(log, frame)
    if boxes is None:
        return {name: dict.fromkeys(COUNTS.values()) for name in (WHOLE, *views)}
    inside = {WHOLE: boxes.valid}
    inside |= {name: boxes.valid & view.sector.contains(boxes.centre) for name, view in views.items()}
    return {name: _by_class(boxes.category[keep]) for name, keep in inside.items()}


def _by_class(category: Tensor) -> dict[str, int | None]:
    counted = torch.bincount(category, minlength=len(Category)).tolist()
    return {name: counted[kind] for kind, name in COUNTS.items()}
