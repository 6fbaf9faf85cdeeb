"""A torch dataset of clips from 123D logs, with voxel labels."""

import dataclasses
import functools
import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch.utils.data import Dataset

from foredrive.data.assemble import assemble_clip
from foredrive.data.cameras import camera_list, find_camera, pinhole_cameras
from foredrive.data.clip_config import ClipConfig
from foredrive.data.commands import command_at, count_command_sources, route_ahead_at
from foredrive.data.frame_store import FrameStore
from foredrive.data.label_store import LabelStore
from foredrive.data.lidar import frames_with_lidar, read_sweep
from foredrive.data.log_paths import LogPath
from foredrive.data.logs import Log
from foredrive.data.maps import read_map_patch
from foredrive.data.recorded import read_expert_plan
from foredrive.data.recorded_labels import check_recorded_occupancy
from foredrive.data.truth.contacts import demonstrates
from foredrive.data.truth.store import TaskTruthStore
from foredrive.errors import InputError
from foredrive.scene import Clip, Example, Trajectory, VoxelGrid
from foredrive.scene.task_truth import TaskTruth


class ClipDataset(Dataset[Example]):
    """All clips of some logs, unbatched, ordered by log and time.

    Files are opened at the first access in each process, and the dataset can be pickled. DataLoader workers
    need the forkserver start method: `DataLoader(..., multiprocessing_context="forkserver")`.

    Args:
        logs: at least one log.
        cache_dir: folder for voxel labels and frames with resized images. None disables the cache.
        images: False reads the same clips without their images: all views are then unseen.

    Raises:
        InputError: a log cannot be read, is too short for one clip or lacks the requested occupancy, or no
            log has a requested camera.
    """

    camera_names: tuple[str, ...]

    def __init__(
        self, logs: Sequence[LogPath], config: ClipConfig, cache_dir: Path | None, *, images: bool = True
    ) -> None:
        if not logs:
            raise InputError("a data set needs at least one log")
        self.config, self._images = config, images
        self.logs = [Log(path) for path in logs]
        self._cameras = [pinhole_cameras(log) for log in self.logs]
        self.camera_names = self._choose_cameras()
        self._frames = FrameStore(cache_dir, config.image_hw, self.camera_names)
        self._labels = LabelStore(cache_dir, config.voxels, config.occupancy_source)
        self._truth = None if config.tasks is None else TaskTruthStore(cache_dir, config.tasks, config.voxels)
        if config.occupancy_source == "recorded":
            for log in self.logs:
                check_recorded_occupancy(log)
        whole = [_clip_frames(log, config) for log in self.logs]
        self._whole = [len(of_log) for of_log in whole]
        frames = [self._sensed_now(number, of_log) for number, of_log in enumerate(whole)]
        self._clip_frames = np.concatenate(frames)
        # For each clip the number of its log
        self._clip_logs = np.repeat(np.arange(len(self.logs)), [len(of_log) for of_log in frames])
        if not len(self):
            raise InputError(f"{logs[0].folder}: none of the selected parts is long enough for a clip")

    def __len__(self) -> int:
        return len(self._clip_logs)

    @functools.cached_property
    def command_source(self) -> dict[str, int]:
        """Number of clips by source of their command: "route" (provided), "driven_future" or "none".

        Raises:
            InputError: a route cannot be read.
        """
        counts = Counter({"route": 0, "driven_future": 0, "none": 0})
        nows = self._clip_frames[:, self.config.past_frames]
        for number, log in enumerate(self.logs):
            of_log = nows[self._clip_logs == number]
            counts.update(
                count_command_sources(log, of_log, self.config.horizon_steps, self.config.horizon_dt_s)
            )
        return dict(counts)

    @functools.cached_property
    def touching(self) -> int:
        """Number of clips without a future to learn from, because the vehicle touches somebody in it.

        Clips whose future is an expert's plan do not count.

        Raises:
            InputError: boxes or a plan cannot be read.
        """
        nows = self._clip_frames[:, self.config.past_frames].tolist()
        by_log = [(self.logs[number], now) for number, now in zip(self._clip_logs, nows, strict=True)]
        return sum(
            not self._demonstrates(log, now) and self._expert_plan(log, now) is None for log, now in by_log
        )

    @functools.cached_property
    def left_out(self) -> dict[str, int]:
        """Number of times of the logs, `now_stride_s` apart, that are no clip's now, by reason.

        "past", "future": the log begins or ends too near; "gap": a frame is missing; "unseen": there is
        neither an image nor a sweep. Times outside of selected parts do not count.
        """
        counts = dict.fromkeys(("past", "future", "gap", "unseen"), 0)
        past_us, future_us = (
            frames * self.config.frame_dt_s * 1e6
            for frames in (self.config.past_frames, self.config.future_frames)
        )
        for number, log in enumerate(self.logs):
            if log.path.parts_s or self.config.part_s is not None:
                continue
            stride_us = 1e6 * max(self.config.now_stride_s, log.period_s)  # a frame is one now
            slack_us, length_us = 0.5e6 * log.period_s, float(log.t_us[-1] - log.t_us[0])
            # The times on the grid of `_clip_frames`, which begins where there is enough of a past
            last = math.floor((length_us + slack_us - past_us) / stride_us)
            with_future = math.floor((length_us + slack_us - past_us - future_us) / stride_us)
            before = math.floor((past_us + slack_us) / stride_us)
            whole, seen = self._whole[number], int((self._clip_logs == number).sum())
            counts["past"] += before
            counts["future"] += last - with_future
            counts["gap"] += max(with_future + 1 - whole, 0)
            counts["unseen"] += whole - seen
        return counts

    def _sensed_now(self, number: int, clips: Int64[np.ndarray, "N T"]) -> Int64[np.ndarray, "_ T"]:
        """Return the clips whose now has an image or a sweep, if the log has images of the chosen cameras.

        A log may continue without images, so that the last images have a true future.
        """
        log, cameras = self.logs[number], self._cameras[number]
        chosen = [camera for name in self.camera_names if (camera := find_camera(cameras, name)) is not None]
        sensed = [log.rows(camera.modality_key)[0] for camera in chosen]
        # Without any image of the chosen cameras all clips are kept
        if not any(len(frames) for frames in sensed):
            return clips
        sensed += [frames_with_lidar(log)] if self.config.lidar else []
        return clips[np.isin(clips[:, self.config.past_frames], np.concatenate(sensed))]

    def frames_of(self, index: int) -> tuple[int, list[int]]:
        """Return the number of the log of a clip in `logs`, and the clip's frames."""
        return int(self._clip_logs[index]), self._clip_frames[index].tolist()

    def now_us(self, index: int) -> int:
        """Return the now of a clip in the time of its log, µs."""
        number, frames = self.frames_of(index)
        return int(self.logs[number].t_us[frames[self.config.past_frames]])

    def log_path(self, index: int) -> LogPath:
        """Return the log of a clip."""
        return self.logs[self._clip_logs[index]].path

    def key(self, index: int) -> str:
        """Return the name of the log and the time of the now of a clip, for messages."""
        return f"{self.log_path(index).name}@{self.now_us(index)}"

    def __getitem__(self, index: int) -> Example:
        """Read one clip with its labels.

        Raises:
            InputError: data cannot be read.
        """
        number, frames = self.frames_of(index)
        log = self.logs[number]
        labels = [self._labels.labels(log, frame) for frame in frames]
        occupied = torch.stack([label.occupied for label in labels])
        return Example(
            clip=self.clip(index),
            occupancy=VoxelGrid(
                spec=self.config.voxels,
                values=occupied[:, None].float(),
                known=torch.stack([label.known for label in labels]),
            ),
            flow=VoxelGrid(
                spec=self.config.voxels,
                values=torch.stack([label.flow_mps for label in labels]),
                known=torch.stack([label.flow_known for label in labels]),
            ),
            key=(self.key(index),),
            truth=self.truth(index),
        )

    def demonstration(self, index: int) -> tuple[float, Trajectory]:
        """Read the speed at the now of a clip (0 where unknown) and its future alone.

        Raises:
            InputError: the future cannot be read.
        """
        number, frames = self.frames_of(index)
        log, now = self.logs[number], frames[self.config.past_frames]
        return float(np.nan_to_num(log.speed_mps[now])), self._future(log, now)

    def truth(self, index: int) -> TaskTruth | None:
        """Read only the ground truth of a clip. Return None if the configuration requests none.

        Raises:
            InputError: data cannot be read.
        """
        if self._truth is None:
            return None
        number, frames = self.frames_of(index)
        cameras = [find_camera(self._cameras[number], name) for name in self.camera_names]
        return self._truth.read(self.logs[number], frames[self.config.past_frames], cameras)

    def _choose_cameras(self) -> tuple[str, ...]:
        if self.config.cameras is None:
            return tuple(dict.fromkeys(name for cameras in self._cameras for name in cameras))
        for name in self.config.cameras:
            if not any(find_camera(cameras, name) for cameras in self._cameras):
                names = camera_list(camera for cameras in self._cameras for camera in cameras.values())
                raise InputError(f"no log has a camera {name!r}; there are: {names}")
        return self.config.cameras

    def _future(self, log: Log, now: int) -> Trajectory:
        steps, dt_s = self.config.horizon_steps, self.config.horizon_dt_s
        if (plan := self._expert_plan(log, now)) is not None:
            return _at_times(plan, dt_s * np.arange(1, steps + 1))
        driven = log.driven_future(now, steps, dt_s)
        if self._demonstrates(log, now):
            return driven
        # Nobody learns from a drive through somebody, or is measured by it
        return dataclasses.replace(driven, valid=torch.zeros_like(driven.valid))

    def _expert_plan(self, log: Log, now: int) -> Trajectory | None:
        return read_expert_plan(log, now) if self.config.future_source == "expert" else None

    def _demonstrates(self, log: Log, now: int) -> bool:
        """Return whether the driven future shows how to drive."""
        return demonstrates(log, now, self.config.horizon_steps * self.config.horizon_dt_s)

    def clip(self, index: int) -> Clip:
        """Read one clip without its labels.

        Raises:
            InputError: data cannot be read.
        """
        number, frames = self.frames_of(index)
        log, config = self.logs[number], self.config
        now = frames[config.past_frames]
        driven = log.driven_future(now, config.horizon_steps, config.horizon_dt_s)
        command, _ = command_at(log, now, driven)
        cameras = [find_camera(self._cameras[number], name) for name in self.camera_names]
        seen = [
            self._frames.read(log, frame, cameras, self._images and (config.future_images or frame <= now))
            for frame in frames
        ]
        return assemble_clip(
            log,
            frames,
            now,
            seen,
            [read_sweep(log, frame) if config.lidar else None for frame in frames],
            self._future(log, now),
            command=command,
            route=route_ahead_at(log, now),
            map_patch=read_map_patch(log, now) if config.map else None,
        )


def _clip_frames(log: Log, config: ClipConfig) -> Int64[np.ndarray, "N T"]:
    """Return the frames of each clip: those nearest to the key times, at most half the log's period away."""
    offset_us = np.arange(-config.past_frames, config.future_frames + 1) * config.frame_dt_s * 1e6
    slack_us = 0.5e6 * log.period_s
    first_us = log.t_us[0] - offset_us[0]
    last_us = log.t_us[-1] - offset_us[-1]
    # Times of a now with enough frames before and after it, then the frames nearest to them
    now_us = np.arange(first_us, last_us + slack_us + 1, config.now_stride_s * 1e6)
    now, valid = log.nearest_frames(now_us)
    now = np.unique(now[valid])
    frames, valid = log.nearest_frames(log.t_us[now][:, None] + offset_us)
    # A frame may not be used twice in a clip, as where the log has a gap
    whole = valid.all(-1) & (np.diff(frames, axis=-1) > 0).all(-1)
    if config.part_s is not None:
        t_s = (log.t_us[frames[:, config.past_frames :]] - log.t_us[0]) * 1e-6
        whole &= (t_s[:, 0] >= config.part_s[0]) & (t_s[:, -1] < config.part_s[1])
    if log.path.parts_s:
        now_s = (log.t_us[frames[:, config.past_frames]] - log.t_us[0]) * 1e-6
        whole &= np.any([(now_s >= start) & (now_s < end) for start, end in log.path.parts_s], axis=0)
    if not whole.any() and not log.path.parts_s:  # A listed part may be at the end of its log
        raise InputError(
            f"{log.path.folder}: too short for one clip: {len(offset_us)} frames {config.frame_dt_s} s apart "
            f"do not fit into its {len(log)} frames of {(log.t_us[-1] - log.t_us[0]) * 1e-6:.1f} s"
            + ("" if config.part_s is None else f", or not into the part {config.part_s}")
        )
    clips: np.ndarray = frames[whole]
    return clips


def _at_times(plan: Trajectory, times_s: Float64[np.ndarray, "T"]) -> Trajectory:
    """Resample a plan of one alternative at evenly spaced times. Times beyond its end are not valid."""
    # The plan begins at the origin now, one step before its first waypoint
    known_s = plan.dt_s * np.arange(len(plan.xy[0]) + 1)
    yaw = np.unwrap(np.append(0.0, plan.yaw[0].double().numpy()))
    x, y = (np.append(0.0, axis) for axis in plan.xy[0].double().numpy().T)
    sampled = torch.from_numpy(
        np.stack([np.interp(times_s, known_s, values) for values in (x, y, yaw)])
    ).float()
    return Trajectory(
        xy=sampled[:2].T[None],
        yaw=sampled[None, 2],
        valid=torch.from_numpy(times_s <= known_s[-1] + 1e-6)[None],
        log_prob=plan.log_prob,
        dt_s=float(times_s[0]),
    )
