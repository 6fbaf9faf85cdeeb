"""One log over time: each frame's sensor data, and a run's predictions."""

import dataclasses
import functools
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Int, UInt8
from torch import Tensor

from foredrive.data import ClipConfig, ClipDataset, LogPath, collate
from foredrive.data.cameras import pinhole_cameras
from foredrive.data.lidar import frames_with_lidar
from foredrive.data.logs import Log
from foredrive.data.truth.semantic_labels import read_semantics
from foredrive.errors import InputError
from foredrive.scene import Clip, VoxelSpec
from foredrive.scene.semantics import Taxonomy

if TYPE_CHECKING:
    from foredrive.runs import Run
    from foredrive.runs.evaluate.display import DisplayPrediction, DisplayPredictor

NO_LABELS = VoxelSpec((-1.0, -1.0, -1.0), 1.0, (2, 2, 2))
"""Voxel grid of the labels, which every clip has and this module does not use."""
KEPT = 16
CAMERA_WIDTH_PX = 640


class LogFrames:
    """The frames of a log in the order of time.

    Args:
        path: path of the log.
        image_width_px: width to which camera images are read.
        run: a trained run; None: show only the log.

    Raises:
        InputError: the log cannot be read; the run has no weights yet; the log lacks the cameras of the run's
            model, or is too short for it.
    """

    predictor: "DisplayPredictor | None"
    """Predicts with the run; None without a run."""
    taxonomy: Taxonomy | None = None
    """Classes of the run's semantic voxels; None without such a head."""

    def __init__(self, path: LogPath, image_width_px: int, run: "Run | None" = None) -> None:
        self._log = log = Log(path)
        camera = next(iter(pinhole_cameras(log).values()), None)
        aspect = 9 / 16 if camera is None else camera.height / camera.width
        self.name, self.run = path.name, run
        self.duration_s = float(log.t_us[-1] - log.t_us[0]) * 1e-6
        config = ClipConfig(
            past_frames=0,
            # One key frame, and every frame of the log is a now
            future_frames=0,
            image_hw=(round(image_width_px * aspect), image_width_px),
            voxels=NO_LABELS,
            now_stride_s=log.period_s or 1.0,
            lidar=True,
            map=True,
        )
        self._clips = ClipDataset([path], config, cache_dir=None)
        self.now_us = [self._clips.now_us(index) for index in range(len(self._clips))]
        """Time of every frame on the log's clock, µs."""
        self.t_s = [(t_us - int(log.t_us[0])) * 1e-6 for t_us in self.now_us]
        """Time of every frame since the start of the log, s."""
        self.predictor = None
        if run is not None:
            from foredrive.runs.evaluate.display import DisplayPredictor
            from foredrive.runs.train.run import load_agent  # Models are imported only for a run
            from foredrive.runs.train.tasks import load_heads

            size, trained = run.recipe.clips, load_heads(run)
            heads = None if trained is None else trained.heads
            self.predictor = DisplayPredictor(load_agent(run), size.future_frames, heads)
            if heads is not None and heads.voxels is not None:
                self.taxonomy = heads.voxels.taxonomy
            # The model's own clips, also at every frame, without the future that it does not see
            seen = dataclasses.replace(
                size,
                future_frames=0,
                voxels=NO_LABELS,
                now_stride_s=config.now_stride_s,
                occupancy_source="lidar",
            )
            self._observed = ClipDataset([path], seen, cache_dir=None)
            # The clips of both data sets are matched by time: those of the model begin later
            index_at = {self._observed.now_us(index): index for index in range(len(self._observed))}
            self._observed_index = [index_at.get(t_us) for t_us in self.now_us]
        self.clip = functools.lru_cache(KEPT)(self._clip)
        self.true_classes = functools.lru_cache(KEPT)(self._true_classes)
        self.prediction = functools.lru_cache(KEPT)(self._prediction)

    def __len__(self) -> int:
        return len(self._clips)

    def nearest(self, t_s: float | None) -> int:
        """Return the frame nearest to a time since the start of the log.

        By default it is, of the frames at which most sensors have data, the one nearest to the middle.

        Raises:
            InputError: the log has no such time.
        """
        wanted_s = self.duration_s / 2 if t_s is None else t_s
        if not 0 <= wanted_s <= self.duration_s:
            raise InputError(f"{self.name}: no time {wanted_s:g} s in this log of {self.duration_s:.2f} s")
        lacking = self._lacking_sensors() if t_s is None else np.zeros(len(self))
        return min(range(len(self)), key=lambda index: (lacking[index], abs(self.t_s[index] - wanted_s)))

    def _lacking_sensors(self) -> Int[np.ndarray, "N"]:
        """Return how many cameras and lidars have no data at each frame; a run's prediction is one more."""
        rows = np.searchsorted(self._log.t_us, self.now_us)
        lacking = np.zeros(len(self), np.int64)
        for frames in (
            frames_with_lidar(self._log),
            *(self._log.rows(camera.modality_key)[0] for camera in pinhole_cameras(self._log).values()),
        ):
            lacking += ~np.isin(rows, frames)
        if self.run is not None:
            lacking += np.array([index is None for index in self._observed_index])
        return lacking

    def _clip(self, index: int) -> Clip:
        """Read a frame as a clip of one key frame, without batch dimension."""
        return self._clips[index].clip

    def _true_classes(self, index: int) -> UInt8[Tensor, "Z Y X"] | None:
        """Read the recorded classes of a frame's voxels, on the grid of the run; None if there are none."""
        if self.run is None or self.taxonomy is None:
            return None
        frame = int(np.searchsorted(self._log.t_us, self.now_us[index]))
        semantics = read_semantics(self._log, frame, self.run.recipe.clips.voxels, self.taxonomy, [])
        return semantics.index if bool(semantics.known.any()) else None

    def _prediction(self, index: int) -> "DisplayPrediction | None":
        """Predict with the run; None without a run, and at frames without enough past."""
        if self.predictor is None or (seen := self._observed_index[index]) is None:
            return None
        return self.predictor.predict(collate([self._observed[seen]]).clip.observed())
