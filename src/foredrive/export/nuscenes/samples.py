"""The choice of key frames of a log: nuScenes' samples."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int64

from foredrive.data.logs import Log
from foredrive.errors import InputError
from foredrive.export.nuscenes.tables import Row, link, token


@dataclass(frozen=True)
class Samples:
    """The key frames of a log, in order of time."""

    log_name: str
    frames: Int64[np.ndarray, "K"]
    t_us: Int64[np.ndarray, "K"]

    def token_of(self, frame: int) -> str:
        """Return the sample of a frame: its own or the next one, after the last one that.

        The devkit interpolates boxes of a frame between its sample and the sample before.
        """
        at = min(int(np.searchsorted(self.frames, frame)), len(self.frames) - 1)
        return token("sample", self.log_name, self.t_us[at])

    def rows(self, scene_token: str) -> list[Row]:
        """Return the table `sample`."""
        rows: list[Row] = [
            {"token": self.token_of(frame), "timestamp": t_us, "scene_token": scene_token}
            for frame, t_us in zip(self.frames.tolist(), self.t_us.tolist(), strict=True)
        ]
        link(rows)
        return rows


def choose_samples(log: Log, rate_hz: float, present: dict[str, Int64[np.ndarray, "_"]]) -> Samples:
    """Choose frames at a rate. Each has all that the log has: samples of nuScenes lack no sensor.

    After a gap the next whole frame is chosen.

    Args:
        log: the log.
        rate_hz: samples a second.
        present: the frames at which each sensor has data, by its name; those of the boxes too.

    Raises:
        InputError: no frame has everything.
    """
    whole = np.arange(len(log))
    for frames in present.values():
        whole = np.intersect1d(whole, frames)
    if not len(whole):
        found = ", ".join(f"{name} {len(frames)}" for name, frames in present.items())
        raise InputError(f"{log.path.folder}: no frame has all sensors and boxes (frames with: {found})")
    t_us, step_us, slack_us = log.t_us[whole], 1e6 / rate_hz, 0.5e6 * log.period_s
    chosen = [0]
    while True:
        wanted_us = t_us[chosen[-1]] + step_us
        at = max(int(np.searchsorted(t_us, wanted_us - slack_us)), chosen[-1] + 1)
        if at >= len(t_us):
            break
        if at + 1 < len(t_us) and abs(t_us[at + 1] - wanted_us) < abs(t_us[at] - wanted_us):
            at += 1
        chosen.append(at)
    return Samples(log.path.name, whole[chosen], t_us[chosen])
