"""Difference between the towns' sensors and real ones: statistics of lidar sweeps and images, side by side.

`foredrive bench domain-gap`, with the raw PandaSet log in FOREDRIVE_REAL_DATA/pandaset.
"""

import functools
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8

from benchmarks.common.benchmark import Benchmark
from foredrive.data import ClipConfig, ClipDataset
from foredrive.data.formats.convert import convert
from foredrive.errors import InputError
from foredrive.scene import LidarSweep, VoxelSpec
from foredrive.scene.conditions import CONDITIONS
from foredrive.sensors.rigs import camera_rig
from foredrive.sensors.vehicle import find_lidar
from foredrive.towns.map.loading import load_town_map
from foredrive.towns.sensing.capture import SensorSuite
from foredrive.towns.traffic.expert import ExpertDrive
from foredrive.towns.traffic.traffic import Traffic
from foredrive.towns.world import World

SIZE_HW = (216, 384)
FRAMES, SPACING_S = 10, 2.0
VEHICLES, PEOPLE = 60, 40
BEAMS = 64 * 1800
"""Number of beams of a Pandar64 at 10 Hz."""
BANDS_DEG = (-14.0, -6.0, 2.0)
"""Elevations between the Pandar64's dense and sparse channels, degrees."""


class Sensed(NamedTuple):
    """One moment."""

    sweep: LidarSweep
    images: UInt8[np.ndarray, "C H W 3"]


def real() -> Iterator[Sensed]:
    """Yield frames of the PandaSet log, spread over it."""
    source = Path(os.environ.get("FOREDRIVE_REAL_DATA", "../shared/data")) / "pandaset"
    if not source.is_dir():
        raise InputError(f"{source}: no raw PandaSet logs here; name their parent in FOREDRIVE_REAL_DATA")
    with tempfile.TemporaryDirectory() as root:
        logs = list(convert(source, "pandaset", Path(root)))
        config = ClipConfig(
            past_frames=0,
            future_frames=0,
            image_hw=SIZE_HW,
            voxels=VoxelSpec((-1.0, -1.0, -1.0), 1.0, (2, 2, 2)),
            now_stride_s=0.5,
            lidar=True,
        )
        dataset = ClipDataset(logs, config, cache_dir=None)
        for index in np.linspace(0, len(dataset) - 1, FRAMES).astype(int).tolist():
            clip = dataset[index].clip
            yield Sensed(clip.sweeps[clip.now], clip.images[clip.now].permute(0, 2, 3, 1).numpy())


def town(name: str, conditions: str, seed: int) -> Iterator[Sensed]:
    """Yield frames of a drive with a Pandar64 on the roof."""
    town_map = load_town_map(name)
    world = World(town_map, seed, CONDITIONS[conditions])
    sensors = SensorSuite(camera_rig(SIZE_HW), find_lidar("pandar64"))
    drive = ExpertDrive(Traffic(town_map, seed, VEHICLES + 1, PEOPLE), FRAMES * SPACING_S)
    for index, m in enumerate(drive.snapshots(FRAMES, SPACING_S)):
        seen = world.render(m.actors, sensors, m.T_world_ego, m.twist_ego, index, m.lights)
        assert seen.sweep is not None
        yield Sensed(seen.sweep, np.stack(list(seen.images.values())))


def statistics(frames: Iterator[Sensed]) -> dict[str, float]:
    """Return the statistics over all frames."""
    lidar: list[Float[np.ndarray, "N 3"]] = []
    pictures: list[dict[str, float]] = []
    points = []
    for sensed in frames:
        sweep = sensed.sweep[sensed.sweep.valid & sensed.sweep.returned]
        elevation = torch.asin(sweep.dir_ego[:, 2]).rad2deg()
        lidar.append(torch.stack([elevation, sweep.range_m, sweep.intensity], dim=-1).numpy())
        points.append(len(elevation))
        pictures += [_of_image(image) for image in sensed.images]
    elevation, range_m, intensity = np.concatenate(lidar).T
    edges = (-90.0, *BANDS_DEG, 90.0)
    share, _ = np.histogram(elevation, edges)
    figures = {
        "lidar.points": float(np.mean(points)),
        "lidar.drop_pct": 100 * (1 - float(np.mean(points)) / BEAMS),
    }
    names = ("below_-14deg", "-14_to_-6deg", "-6_to_2deg", "above_2deg")
    figures |= {f"lidar.{n}_pct": 100 * float(s / share.sum()) for n, s in zip(names, share, strict=True)}
    for q in (10, 25, 50, 75, 90):
        figures[f"lidar.range_p{q}_m"] = float(np.percentile(range_m, q))
        figures[f"lidar.intensity_p{q}"] = float(np.percentile(intensity, q))
    return figures | {
        f"image.{key}": float(np.mean([picture[key] for picture in pictures])) for key in pictures[0]
    }


def _of_image(image: UInt8[np.ndarray, "H W 3"]) -> dict[str, float]:
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255
    hsv = cv2.cvtColor(image, cv2.COLOR_RGB2HSV).astype(np.float32) / 255
    dx, dy = np.diff(grey, axis=1)[:-1], np.diff(grey, axis=0)[:, :-1]
    return {
        "brightness": float(grey.mean()),
        "contrast": float(grey.std()),
        "saturation": float(hsv[..., 1].mean()),
        "gradient": float(np.hypot(dx, dy).mean()),
        "black_pct": 100 * float((grey < 0.02).mean()),
        "white_pct": 100 * float((grey > 0.98).mean()),
    }


def _town_figures(name: str, conditions: str, seed: int) -> dict[str, float]:
    return statistics(town(name, conditions, seed))


BENCHMARK = Benchmark(
    question="How far are the towns' sensors from PandaSet's (log 002, San Francisco, evening sun)?",
    arms={"pandaset_002": lambda seed: statistics(real())}
    | {
        f"{name}_{conditions}": functools.partial(_town_figures, name, conditions)
        for name, conditions in (
            ("Town03", "clear"),
            ("Town05", "clear"),
            ("Town10HD", "clear"),
            ("Town05", "dusk"),
            ("Town05", "rain"),
        )
    },
    seeds=(0,),
    config={"frames": FRAMES, "size_hw": list(SIZE_HW)},
)
