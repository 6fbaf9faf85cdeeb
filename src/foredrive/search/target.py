"""Target vectors of a query, from its texts or its example."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from foredrive.data.cameras import camera_list, find_camera, pinhole_cameras, read_camera
from foredrive.data.lidar import read_sweep
from foredrive.data.log_paths import LogPath, find_logs
from foredrive.data.logs import Log
from foredrive.errors import InputError
from foredrive.search.embedding import View, embed_views, mean_direction, read_views
from foredrive.search.index import FrameIndex
from foredrive.search.query import Like, Query
from foredrive.search.rows import WHOLE
from foredrive.search.sectors import cut_camera
from foredrive.search.tables import quoted
from foredrive.search.towers import PROMPTS, Towers, embed_prompt

_ALONE = ("{}",)


class Target(NamedTuple):
    """Unit vectors by modality (None if missing), and the moment that they come from."""

    image: Float[np.ndarray, "D"] | None
    lidar: Float[np.ndarray, "D"] | None
    moment: tuple[str, int] | None = None
    """Log and time in µs of an example. It is excluded from the results."""


def text_target(query: Query, towers: Towers, *, ensemble: bool = True) -> Target:
    """Return the target of a query's texts.

    Sweeps and images are embedded in one space, so one text is used for both if the other is missing.

    Args:
        ensemble: whether to use several wordings of each text (`towers.PROMPTS`).

    Raises:
        InputError: a text is empty.
    """
    image_text = query.image_text or query.text or query.lidar_text
    lidar_text = query.lidar_text or query.text or query.image_text
    assert image_text is not None
    assert lidar_text is not None
    templates = PROMPTS if ensemble else _ALONE
    by_image = embed_prompt(towers, image_text, templates).numpy()
    same = lidar_text == image_text
    return Target(by_image, by_image if same else embed_prompt(towers, lidar_text, templates).numpy())


class ExampleViews(NamedTuple):
    """The views of an example."""

    views: dict[str, View]
    """Views by name: one view, or all views of a moment."""
    moment: tuple[str, int]
    """Log, and time in µs."""


def example_target(index: FrameIndex, like: Like, towers: Towers) -> Target:
    """Return the target of a moment, view or crop of a log. The log need not be in the index.

    Raises:
        InputError: there is no such log, moment or view, or it cannot be read.
    """
    views, moment = example_views(index, like, towers)
    vectors = [embed_views(towers, [view]) for view in views.values()]
    image, lidar = mean_direction(np.concatenate(vectors))
    return Target(None if np.isnan(image).any() else image, None if np.isnan(lidar).any() else lidar, moment)


def example_views(index: FrameIndex | None, like: Like, towers: Towers) -> ExampleViews:
    """Read the views of an example.

    Args:
        index: index in which logs are found by name. With None, logs are given by their folders.

    Raises:
        InputError: as `example_target`.
    """
    log = Log(_find_log(index, like.log))
    frame, valid = log.nearest_frames(np.array([log.t_us[0] + like.t_s * 1e6]))
    if not valid[0]:
        raise InputError(f"{log.path.name}: has nothing at {like.t_s:g} s; it lasts {_length_s(log):.1f} s")
    moment = (log.path.name, int(log.t_us[frame[0]]))
    if like.crop_px is not None:
        views = {like.view: _cropped(log, int(frame[0]), like, towers)}
    else:
        views = read_views(log, int(frame[0]), towers.image_side_px, towers.crop, with_lidar=towers.has_lidar)
        if like.view != WHOLE:
            camera = find_camera(pinhole_cameras(log), like.view)  # By its own name or by 123D's
            name = like.view if camera is None else camera.camera_name
            if name not in views:
                raise InputError(f"{log.path.name}: no view {like.view}; there are {', '.join(views)}")
            views = {name: views[name]}
    if not views:
        raise InputError(f"{log.path.name}: neither cameras nor lidar at {like.t_s:g} s")
    return ExampleViews(views, moment)


def _find_log(index: FrameIndex | None, name: str) -> LogPath:
    if (Path(name) / "sync.arrow").is_file():
        return find_logs(Path(name))[0]
    if index is None:
        raise InputError(f"{name}: no folder of a log")
    # The name without its split is accepted if only one log of the index has it
    end = quoted("/" + name)
    rows = index.select(
        f"view = {quoted(WHOLE)} AND (log = {quoted(name)} OR ends_with(log, {end}))",
        ["log", "folder", "maps_dir"],
    ).to_pylist()
    logs = {row["log"]: LogPath(Path(row["folder"]), Path(row["maps_dir"])) for row in rows}
    if len(logs) != 1:
        raise InputError(
            f"{name}: no log of this name in the index, and no folder of one"
            if not logs
            else f"{name}: several logs have this name: {', '.join(sorted(logs))}; add the split"
        )
    return next(iter(logs.values()))


def _cropped(log: Log, frame: int, like: Like, towers: Towers) -> View:
    """Return a part of an image as a view. The towers' own crop applies to this part."""
    metadata = find_camera(pinhole_cameras(log), like.view)
    if metadata is None:
        cameras = camera_list(pinhole_cameras(log).values())
        raise InputError(f"{log.path.name}: no camera {like.view}; there are: {cameras}")
    camera = read_camera(log, frame, metadata, (metadata.height, metadata.width), with_image=True)
    assert like.crop_px is not None
    left, top, right, bottom = like.crop_px
    if camera.image is None or right > metadata.width or bottom > metadata.height:
        raise InputError(
            f"{log.path.name}: the crop lies outside the image of {metadata.width} x {metadata.height} px"
            if camera.image is not None
            else f"{log.path.name}: no image of {like.view} at {like.t_s:g} s"
        )
    part = cut_camera(camera, like.crop_px)
    sweep = read_sweep(log, frame) if towers.has_lidar else None
    # The tower's crop applies to the part that was chosen, not to the whole image
    seen = cut_camera(part, towers.crop.box_px((bottom - top, right - left)))
    return View.of_camera(seen, None if sweep is None else sweep[0])


def _length_s(log: Log) -> float:
    return float(log.t_us[-1] - log.t_us[0]) * 1e-6
