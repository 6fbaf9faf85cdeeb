"""A check of a log: its content, and problems in it."""

import contextlib
import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Float64

from foredrive.data.boxes import read_boxes, read_tracks, with_counted_points
from foredrive.data.cameras import pinhole_cameras, read_camera
from foredrive.data.ego_path import MAX_GAP_S, STANDS_M
from foredrive.data.lidar import frames_with_lidar, read_sweep
from foredrive.data.log_paths import LogPath
from foredrive.data.logs import Log
from foredrive.data.mosaic_check import is_mosaic
from foredrive.data.notices import read_notices
from foredrive.data.sweep_check import MAX_BURIED_SHARE, buried_share, shifted_sweeps
from foredrive.errors import InputError
from foredrive.geometry.projection import project
from foredrive.geometry.se3 import inverse_se3, transform_points
from foredrive.scene import LidarSweep

Level = Literal["problem", "note"]
SAMPLES = 12
"""Images and sweeps that are opened, evenly over the log."""
CHECK_HW = (135, 240)
"""Size at which sampled images are compared, px."""
MAX_ACCELERATION_MPS2, MAX_TURN_RADPS, MAX_TILT_RAD = 15.0, 1.5, 0.35
"""Limits of the motion of road vehicles."""
SPEED_DIFFERS_MPS, SPEED_DIFFERS_SHARE = 1.0, 0.1
EVEN_MPS, JERK_MPS = 1e-3, 0.3
"""Velocities that differ by less are equal, and a change from which a straight line is no drive."""
MAX_STRETCH = 0.03
"""Share by which the focal lengths of a camera may differ."""
MIN_SEEN_POINTS, SECTOR_RAD = 5, np.deg2rad(10.0)
STEEP_RAD, LEVEL_RAD, ALL_AROUND_RAD = np.deg2rad((60.0, 10.0, 330.0))
"""Angles of a camera's axis from the horizon: too steep, and level; and a lidar that sees all around."""
GAP = 1.5
"""A gap is longer than this many times the sensor's usual period."""
MAX_GROUND_M, NEAR_GROUND_M = 0.3, (4.0, 12.0)
"""Maximum height of the ground in the ego frame, and the range of distances at which it is measured."""
MIN_GROUND_POINTS = 200
NEAR_BOX_M, MAX_EMPTY_SHARE = 25.0, 0.3
MAX_BOX_MPS = 60.0
MIN_MOVING_MPS = 1.0
"""Speed from which an image differs from the one before."""
DARK, SAME = 4.0, 0.5
"""An image is black below this mean value; two images are the same below this mean difference (of 255)."""


@dataclass(frozen=True)
class Finding:
    """One observation about a log."""

    level: Level
    """problem: results will be wrong or a verb will refuse the log; note: for information."""
    subject: str
    text: str


@dataclass(frozen=True)
class Stream:
    """One sensor or kind of label."""

    name: str
    count: int
    """Number of frames that have it."""
    period_s: float | None
    """Usual time between two of them; None for fewer than two."""
    detail: str


@dataclass(frozen=True)
class LogCheck:
    """The content of a log, and the findings."""

    log: str
    frames: int
    duration_s: float
    driven_m: float
    streams: Sequence[Stream]
    findings: Sequence[Finding]


def check_log(path: LogPath) -> LogCheck:
    """Check times, poses, images, sweeps and boxes of a log.

    Raises:
        InputError: the log cannot be opened, or has no ego poses.
    """
    log = Log(path)
    streams = list(_streams(log))
    checks: tuple[Callable[[Log], Iterator[Finding]], ...] = (
        _poses,
        _straight_holes,
        _images,
        _views,
        _sweeps,
        _tracks,
    )
    findings = [Finding("note", "conversion", notice) for notice in read_notices(path.folder)]
    findings += _gaps(log, streams)
    for check in checks:
        findings += check(log)
    step_m = np.linalg.norm(np.diff(log.T_world_ego[:, :3, 3], axis=0), axis=-1)
    duration_s = float(log.t_us[-1] - log.t_us[0]) * 1e-6
    return LogCheck(path.name, len(log), duration_s, float(step_m.sum()), streams, findings)


def _streams(log: Log) -> Iterator[Stream]:
    cameras = pinhole_cameras(log)
    for key, metadata in log.scene.get_all_modality_metadatas().items():
        frames, _ = log.rows(key)
        detail = ""
        for name, camera in cameras.items():
            if camera is metadata:
                detail = f"{name}, {camera.width} x {camera.height} px"
        yield Stream(key, len(frames), _period_s(log, frames), detail)


def _period_s(log: Log, frames: np.ndarray) -> float | None:
    return float(np.median(np.diff(log.t_us[frames]))) * 1e-6 if len(frames) > 1 else None


def _gaps(log: Log, streams: Sequence[Stream]) -> Iterator[Finding]:
    """Find times without poses or sensors, beyond the usual period. Streams with equal gaps are joined."""
    streams_of: dict[str, list[str]] = {}
    for stream in streams:
        frames, _ = log.rows(stream.name)
        if not len(frames):
            streams_of.setdefault("declared, but no frame has it", []).append(stream.name)
            continue
        if stream.period_s is None:
            continue
        since_s = np.diff(log.t_us[frames]) * 1e-6
        gaps = np.flatnonzero(since_s > GAP * stream.period_s)
        if len(gaps):
            longest = int(gaps[since_s[gaps].argmax()])
            start_s = float(log.t_us[frames[longest]] - log.t_us[0]) * 1e-6
            count = "1 gap; it" if len(gaps) == 1 else f"{len(gaps)} gaps; the longest"
            text = (
                f"{count} lasts {since_s[longest]:.2f} s, from {start_s:.2f} s "
                f"(usually {stream.period_s:.3f} s)"
            )
            streams_of.setdefault(text, []).append(stream.name)
    for text, names in streams_of.items():
        yield Finding("note", names[0] if len(names) == 1 else f"{len(names)} streams", _named(text, names))


def _named(text: str, names: Sequence[str]) -> str:
    return text if len(names) == 1 else f"{text}: {', '.join(names)}"


def _poses(log: Log) -> Iterator[Finding]:
    """Find motion that is impossible for a road vehicle, and speeds that do not fit the poses."""
    if len(log) < 3:
        return
    t_s = (log.t_us - log.t_us[0]) * 1e-6
    dt_s = np.diff(t_s)
    velocity = np.diff(log.T_world_ego[:, :3, 3], axis=0) / dt_s[:, None]
    acceleration = np.linalg.norm(np.diff(velocity, axis=0), axis=-1) / (0.5 * (dt_s[1:] + dt_s[:-1]))
    yield from _jumps(acceleration > MAX_ACCELERATION_MPS2, acceleration, t_s[1:-1], "accelerates by", "m/s²")
    turn = np.diff(np.unwrap(np.arctan2(log.T_world_ego[:, 1, 0], log.T_world_ego[:, 0, 0]))) / dt_s
    yield from _jumps(np.abs(turn) > MAX_TURN_RADPS, np.abs(turn), t_s[1:], "turns at", "rad/s")
    # The angle between the z axes of vehicle and world
    tilt = np.arccos(log.T_world_ego[:, 2, 2].clip(-1, 1))
    yield from _jumps(tilt > MAX_TILT_RAD, tilt, t_s, "is tilted by", "rad; is the world's z up?")
    ahead = (velocity * log.T_world_ego[:-1, :3, 0]).sum(axis=-1)
    speed = np.linalg.norm(velocity, axis=-1)
    moving = speed > 2.0
    # A vehicle that moves sideways has another convention of axes; the median ignores single slips
    if moving.sum() > 5 and np.median(ahead[moving] / speed[moving]) < 0.8:
        share = float(np.median(ahead[moving] / speed[moving]))
        text = f"the vehicle moves along its own x axis by {share:.0%} only; x should be ahead"
        yield Finding("problem", "ego poses", text)
    differs = np.abs(log.speed_mps[1:] - speed)
    limit = SPEED_DIFFERS_MPS + SPEED_DIFFERS_SHARE * speed
    wrong = np.isfinite(differs) & (differs > limit)
    if wrong.mean() > 0.05:
        most = float(differs[wrong].max())
        text = f"logged speed and poses differ at {wrong.mean():.0%} of the frames, by up to {most:.1f} m/s"
        yield Finding("problem", "ego speed", text)


def _jumps(
    wrong: np.ndarray, value: Float64[np.ndarray, "N"], t_s: Float64[np.ndarray, "N"], verb: str, unit: str
) -> Iterator[Finding]:
    if wrong.any():
        worst = int(value.argmax())
        text = f"the vehicle {verb} {value[worst]:.1f} {unit} at {t_s[worst]:.2f} s"
        yield Finding("problem", "ego poses", f"{text} ({int(wrong.sum())} frames like this)")


def _straight_holes(log: Log) -> Iterator[Finding]:
    """Find poses that were interpolated over a hole: a straight line at one speed, with jerks at its ends."""
    t_s = (log.t_us - log.t_us[0]) * 1e-6
    if len(log) < 5:
        return
    place_m = log.T_world_ego[:, :3, 3]
    velocity = np.diff(place_m, axis=0) / np.diff(t_s)[:, None]
    change = np.linalg.norm(np.diff(velocity, axis=0), axis=-1)
    # Runs of steps with equal velocities, between two changes
    ends = [-1, *np.flatnonzero(change > EVEN_MPS).tolist(), len(change)]
    for before, after in itertools.pairwise(ends):
        first, last = before + 1, after + 1
        lasts_s = float(t_s[last] - t_s[first])
        if np.linalg.norm(place_m[last] - place_m[first]) <= STANDS_M:
            continue
        jerks = [float(change[row]) for row in (before, after) if 0 <= row < len(change)]
        if lasts_s > MAX_GAP_S and last - first > 2 and jerks and min(jerks) > JERK_MPS:
            text = f"from {t_s[first]:.2f} to {t_s[last]:.2f} s the path is a straight line at one speed,"
            text += f" between jerks of up to {max(jerks):.1f} m/s, as interpolated over a hole in the poses"
            yield Finding("problem", "ego poses", text)


def _views(log: Log) -> Iterator[Finding]:
    """Find cameras into whose images no lidar point falls: level ones, and those that look up or down."""
    lidar = set(frames_with_lidar(log).tolist())
    for name, camera in pinhole_cameras(log).items():
        fx, fy = camera.intrinsics.fx, camera.intrinsics.fy
        if abs(fx / fy - 1) > MAX_STRETCH:
            text = f"its focal lengths are {fx:.1f} and {fy:.1f} px: were cut images taken for scaled?"
            yield Finding("note", name, text)
        frames = np.array([k for k in log.rows(camera.modality_key)[0].tolist() if k in lidar], np.int64)
        inside, around, up_rad = [], [], 0.0
        for frame in _sampled(frames):
            try:
                view = read_camera(log, int(frame), camera, CHECK_HW, with_image=False)
                loaded = read_sweep(log, int(frame))
            except InputError:
                continue  # the checks of images and sweeps report it
            if loaded is None:
                continue
            points = loaded[0][loaded[0].returned & loaded[0].valid].points_ego
            _, _, seen = project(
                transform_points(inverse_se3(view.T_ego_cam), points), view.K, view.dist, CHECK_HW
            )
            inside.append(int(seen.sum()))
            azimuth = torch.atan2(points[:, 1], points[:, 0])
            around.append(len((azimuth / SECTOR_RAD).round().unique()) * SECTOR_RAD)
            up_rad = float(torch.asin(view.T_ego_cam[2, 2].clamp(-1, 1)))
        if not inside or np.median(inside) >= MIN_SEEN_POINTS:
            continue
        text = f"no lidar point falls into its images; it looks {np.degrees(up_rad):.0f}° above the horizon"
        # A lidar that sees all around meets what a level camera sees
        wrong = abs(up_rad) > STEEP_RAD or (abs(up_rad) < LEVEL_RAD and np.median(around) > ALL_AROUND_RAD)
        yield Finding("problem" if wrong else "note", name, text)


def _images(log: Log) -> Iterator[Finding]:
    """Find images that cannot be decoded, are black or frozen, and clocks that differ."""
    for name, camera in pinhole_cameras(log).items():
        frames, _ = log.rows(camera.modality_key)
        if not len(frames):
            continue
        read = functools.partial(read_camera, log, metadata=camera, image_hw=CHECK_HW, with_image=True)
        dark, frozen, offset_s = [], [], []
        for frame in _sampled(frames):
            try:
                shown = read(frame=int(frame))
                # An image of a standing vehicle may well equal the next one
                moves = log.speed_mps[frame] > MIN_MOVING_MPS and int(frame) + 1 < len(log)
                following = read(frame=int(frame) + 1) if moves else None
            except InputError as error:
                yield Finding("problem", name, str(error))
                continue
            if shown.image is None:
                continue
            dark.append(float(shown.image.float().mean()) < DARK)
            offset_s.append(shown.exposed_dt_s)
            if following is not None and following.image is not None:
                frozen.append(float((following.image.float() - shown.image.float()).abs().mean()) < SAME)
        if any(dark):
            yield Finding("note", name, f"{sum(dark)} of {len(dark)} sampled images are black")
        if any(frozen):
            text = f"{sum(frozen)} of {len(frozen)} sampled images do not change while driving"
            yield Finding("problem", name, text)
        yield from _clock(name, np.array(offset_s), log.period_s)
        with contextlib.suppress(InputError):  # told above
            if all(is_mosaic(log, int(frame), camera) for frame in frames[[0, len(frames) // 2]]):
                text = "its grey images have the pattern of a colour filter: a mosaic that was not decoded"
                yield Finding("problem", name, text)


def _clock(name: str, offset_s: Float[np.ndarray, "N"], period_s: float) -> Iterator[Finding]:
    if not len(offset_s):
        return
    if np.abs(offset_s).max() > max(period_s, 0.05):
        text = f"exposed up to {np.abs(offset_s).max():.3f} s from the frame's time; is it another clock?"
        yield Finding("problem", name, text)
    elif offset_s.max() - offset_s.min() > 0.02:
        text = f"its time varies by {offset_s.max() - offset_s.min():.3f} s against the frames'"
        yield Finding("note", name, text)


def _sweeps(log: Log) -> Iterator[Finding]:
    """Find empty sweeps and boxes, missing point times, and a ground that does not fit the ego frame."""
    ground_m, buried, empty, untimed, read = [], [], 0, 0, 0
    near, bare = 0, 0
    for frame in _sampled(frames_with_lidar(log)):
        try:
            loaded = read_sweep(log, int(frame))
        except InputError as error:
            yield Finding("problem", "lidar", str(error))
            continue
        if loaded is None:
            continue
        read += 1
        sweep = loaded[0][loaded[0].returned & loaded[0].valid]
        if not len(sweep.range_m):
            empty += 1
            continue
        untimed += not bool(sweep.dt_s.any())
        buried.append(buried_share(sweep.points_ego.numpy()))
        level_m = _ground_level(sweep.points_ego.numpy())
        ground_m += [] if level_m is None else [level_m]
        close, without = _boxes_without_points(log, int(frame), loaded[0])
        near, bare = near + close, bare + without
    if empty:
        yield Finding("problem", "lidar", f"{empty} of {read} sampled sweeps are empty")
    if untimed:
        text = "points have no times of their own: the motion within a sweep is unknown"
        yield Finding("note", "lidar", text)
    if ground_m and abs(np.median(ground_m)) > MAX_GROUND_M:
        text = f"the ground is at z = {np.median(ground_m):.2f} m in the ego frame, which should stand on it"
        yield Finding("problem", "lidar", text)
    if buried and np.median(buried) > MAX_BURIED_SHARE:
        text = f"{np.median(buried):.0%} of the points are far below the ground: were rows or fields misread?"
        yield Finding("problem", "lidar", text)
    for text in shifted_sweeps(log):
        yield Finding("problem", "lidar", text)
    if near and bare / near > MAX_EMPTY_SHARE:
        text = f"{bare} of {near} sampled boxes within {NEAR_BOX_M:.0f} m have no lidar point in them"
        yield Finding("problem", "boxes", text)


def _ground_level(points_m: Float[np.ndarray, "N 3"]) -> float | None:
    """Return the height at which most columns of 1 m nearby have their lowest point: roads are flat.

    Return None if there are too few points.
    """
    distance_m = np.hypot(points_m[:, 0], points_m[:, 1])
    near_m = points_m[(distance_m > NEAR_GROUND_M[0]) & (distance_m < NEAR_GROUND_M[1])]
    if len(near_m) <= MIN_GROUND_POINTS:
        return None
    # Cells of one metre cover the square around the circle of the largest distance
    side = 2 * int(NEAR_GROUND_M[1]) + 2
    # The lowest point of each square metre, in a flat table of cells
    cell = np.floor(near_m[:, :2]).astype(np.int64) + side // 2
    lowest_m = np.full(side * side, np.inf)
    np.minimum.at(lowest_m, cell[:, 0] * side + cell[:, 1], near_m[:, 2])
    lowest_m = lowest_m[np.isfinite(lowest_m)]
    # The most frequent level: cells on cars and walls, and below bridges, differ from each other
    count, edges = np.histogram(lowest_m, bins=np.arange(lowest_m.min(), lowest_m.max() + 0.4, 0.2))
    return float(edges[count.argmax()]) + 0.1


def _boxes_without_points(log: Log, frame: int, sweep: LidarSweep) -> tuple[int, int]:
    """Return the number of near boxes of a frame, and how many of them have no lidar point."""
    try:
        boxes = read_boxes(log, frame)
    except InputError:
        return 0, 0  # `_tracks` reports the error
    if boxes is None:
        return 0, 0
    close = boxes[boxes.valid & (boxes.centre.norm(dim=-1) < NEAR_BOX_M)]
    counted = with_counted_points(close, sweep)
    return len(counted.num_points), int((counted.num_points == 0).sum())


def _tracks(log: Log) -> Iterator[Finding]:
    """Find boxes without size, with impossible speeds, and tracks that occur twice in a frame."""
    try:
        tracks = read_tracks(log)
    except InputError as error:
        yield Finding("problem", "boxes", str(error))
        return
    if tracks is None:
        return
    sizeless = int((tracks.size_lwh <= 0).any(axis=-1).sum())
    if sizeless:
        text = f"{sizeless} of {len(tracks.size_lwh)} have no length, width or height, and are left out"
        yield Finding("note", "boxes", text)
    speed = np.linalg.norm(tracks.velocity, axis=-1)
    fast = np.isfinite(speed) & (speed > MAX_BOX_MPS)
    if fast.any():
        text = f"{len(set(tracks.track_id[fast].tolist()))} tracks move at up to {speed[fast].max():.0f} m/s"
        yield Finding("problem", "boxes", text)
    rows = np.repeat(np.arange(len(tracks.row_t_us)), np.diff(tracks.first_row))
    twice = len(rows) - len(np.unique(np.stack([rows, tracks.track_id]), axis=1).T)
    if twice:
        yield Finding("problem", "boxes", f"{twice} boxes have the track of another box of their frame")


def _sampled(frames: np.ndarray) -> np.ndarray:
    return frames[np.unique(np.linspace(0, len(frames) - 1, min(SAMPLES, len(frames))).round().astype(int))]
