"""What cameras and a lidar sense of a town at one moment."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int32, UInt8

from foredrive.ops.threads import in_parallel
from foredrive.scene import CameraRig, LidarSweep
from foredrive.sensors import SpinningLidar, camera_rays
from foredrive.towns.sensing import raycast, shading
from foredrive.towns.sensing.light import LightArrays

PIXEL_GRAIN, BEAM_GRAIN = 4096, 4096
CREASE_COS = 0.8

Rays = Float32[np.ndarray, "N 3"]


@dataclass(frozen=True)
class SensorSuite:
    """The sensors of the recording vehicle."""

    rig: CameraRig
    """Without leading dimensions."""
    lidar: SpinningLidar
    samples_per_outline_pixel: int = 4
    """A square number. One ray sees a pixel, textures being filtered; where outlines or shadows run through
    it there are this many."""

    @cached_property
    def pixel_rays(self) -> tuple[Rays, Rays]:
        """Origins and directions of the pixels' central rays in the ego frame: cameras, rows, columns."""
        return _flat_rays(self.rig, 1)

    @cached_property
    def outline_rays(self) -> tuple[Rays, Rays]:
        """The same with the rays of an outline pixel next to each other."""
        return _flat_rays(self.rig, self.samples_per_outline_pixel)

    @cached_property
    def pixel_rad(self) -> Float32[np.ndarray, "P"]:
        """Angle between neighbouring pixels, one for each."""
        height, width = self.rig.size_hw
        return (1.0 / self.rig.K[:, 0, 0]).repeat_interleave(height * width).numpy()


def _flat_rays(rig: CameraRig, samples: int) -> tuple[Rays, Rays]:
    rays = camera_rays(rig, samples)
    return rays.origin_ego.reshape(-1, 3).numpy(), rays.dir_ego.reshape(-1, 3).numpy()


@dataclass(frozen=True)
class Moment:
    """A town with its road users where they are at one time."""

    scene: shading.Scene
    static: raycast.TriangleScene
    placed: raycast.PlacedShapes
    light: LightArrays

    def cast(self, origin: Rays, direction: Rays) -> shading.Hits:
        """Nearest hits."""
        return raycast.cast(self.static, self.placed, origin, direction)

    def sunlit(self, found: shading.Surfaces, hits: shading.Hits) -> Bool[np.ndarray, "N"]:
        """Which hits the sun shines on."""
        start = np.empty_like(found.xyz)
        facing = shading.sun_rays(found, hits.t, self.light.sun, start)
        to_sun = np.ascontiguousarray(np.broadcast_to(self.light.sun, (len(facing), 3)))
        lit = np.zeros(len(hits.t), dtype=np.bool_)
        lit[facing] = ~raycast.occluded(self.static, self.placed, start[: len(facing)], to_sun)
        return lit


@dataclass(frozen=True)
class Seen:
    """What rays met: which triangle of which actor, as in `shading.Hits`."""

    triangle: Int32[np.ndarray, "N"]
    actor: Int32[np.ndarray, "N"]
    look: Int32[np.ndarray, "N"]
    """`shading.MISS` where a ray met nothing."""
    range_m: Float32[np.ndarray, "N"]
    """Along the ray; infinite where it met nothing."""


def _nothing_seen(count: int) -> Seen:
    triangle, actor, look = (np.empty(count, np.int32) for _ in range(3))
    return Seen(triangle, actor, look, np.empty(count, np.float32))


def _note(seen: Seen, part: slice, hits: shading.Hits, look: Int32[np.ndarray, "n"]) -> None:
    seen.triangle[part], seen.actor[part], seen.look[part] = hits.triangle, hits.actor, look
    seen.range_m[part] = np.where(look == shading.MISS, np.inf, hits.t)


def see(
    moment: Moment, sensors: SensorSuite, T_world_ego: Float64[np.ndarray, "4 4"]
) -> tuple[UInt8[np.ndarray, "C H W 3"], Seen]:
    """Images of all cameras, and what each pixel's central ray met [C·H·W]."""
    shape = (len(sensors.rig.names), *sensors.rig.size_hw)
    count = int(np.prod(shape))
    rgb = np.empty((count, 3), np.uint8)
    seen = _nothing_seen(count)
    lit, normal = np.empty(count, np.bool_), np.empty((count, 3), np.float32)

    def first_look(start: int, stop: int) -> None:
        part = slice(start, stop)
        rays = _to_world(T_world_ego, sensors.pixel_rays[0][part], sensors.pixel_rays[1][part])
        radiance, hits, found, lit[part] = _look(moment, *rays, sensors.pixel_rad[part])
        rgb[part] = shading.develop(radiance, moment.light.exposure, 1)
        _note(seen, part, hits, found.look)
        normal[part] = found.normal

    in_parallel(first_look, count, PIXEL_GRAIN)
    samples = sensors.samples_per_outline_pixel
    if samples == 1:
        return rgb.reshape(*shape, 3), seen
    kind = np.stack([seen.look, seen.actor, lit], axis=-1).reshape(*shape, 3)
    pixels = np.flatnonzero(_outlines(kind, normal.reshape(*shape, 3)))

    def closer_look(start: int, stop: int) -> None:
        some = pixels[start:stop]
        rows = (some[:, None] * samples + np.arange(samples)).ravel()
        rays = _to_world(T_world_ego, sensors.outline_rays[0][rows], sensors.outline_rays[1][rows])
        ray_rad = np.repeat(sensors.pixel_rad[some], samples) / np.float32(samples**0.5)
        radiance, *_ = _look(moment, *rays, ray_rad)
        rgb[some] = shading.develop(radiance, moment.light.exposure, samples)

    in_parallel(closer_look, len(pixels), PIXEL_GRAIN // samples)
    return rgb.reshape(*shape, 3), seen


def _look(
    moment: Moment, origin: Rays, direction: Rays, ray_rad: Float32[np.ndarray, "N"]
) -> tuple[Rays, shading.Hits, shading.Surfaces, Bool[np.ndarray, "N"]]:
    """Radiance along rays, and what they met."""
    hits = moment.cast(origin, direction)
    found = shading.surfaces(moment.scene, hits, origin, direction, ray_rad)
    lit = moment.sunlit(found, hits)
    radiance = shading.shade(moment.scene.looks, found, hits.t, direction, lit, moment.light)
    return radiance, hits, found, lit


def _outlines(
    kind: Int32[np.ndarray, "C H W 3"], normal: Float32[np.ndarray, "C H W 3"]
) -> Bool[np.ndarray, "C H W"]:
    """Pixels that differ from a neighbour in what they show, in light and shadow, or in their slope."""
    outline = np.zeros(kind.shape[:3], dtype=np.bool_)
    for axis in (1, 2):
        low = (slice(None), *(slice(None, -1) if a == axis else slice(None) for a in (1, 2)))
        high = (slice(None), *(slice(1, None) if a == axis else slice(None) for a in (1, 2)))
        differs = (kind[low] != kind[high]).any(-1)
        differs |= (kind[low][..., 0] >= 0) & ((normal[low] * normal[high]).sum(-1) < CREASE_COS)
        outline[low] |= differs
        outline[high] |= differs
    return outline


def sweep(
    moment: Moment,
    lidar: SpinningLidar,
    T_world_ego: Float64[np.ndarray, "4 4"],
    twist_ego: Float[np.ndarray, "6"],
    rng: np.random.Generator,
) -> tuple[LidarSweep, Seen]:
    """One revolution, and what its beams met.

    A beam that is not returned although it met something is free up to there.
    """
    beams = lidar.beams(torch.from_numpy(np.asarray(twist_ego, dtype=np.float32)))
    origin_ego, dir_ego = beams.origin_ego.numpy(), beams.dir_ego.numpy()
    count = len(dir_ego)
    chance = rng.random((count, 2), dtype=np.float32)
    noise_m = rng.standard_normal(count, dtype=np.float32) * np.float32(lidar.range_noise_m)
    range_m, intensity = np.empty(count, np.float32), np.empty(count, np.float32)
    returned = np.empty(count, np.bool_)
    seen = _nothing_seen(count)
    beam_rad = np.full(count, 2 * np.pi / lidar.azimuth_steps, dtype=np.float32)

    def job(start: int, stop: int) -> None:
        part = slice(start, stop)
        origin, direction = _to_world(T_world_ego, origin_ego[part], dir_ego[part])
        hits = moment.cast(origin, direction)
        found = shading.surfaces(moment.scene, hits, origin, direction, beam_rad[part])
        range_m[part], returned[part], intensity[part] = shading.lidar_returns(
            moment.scene.looks, found, hits.t, np.float32(lidar.max_range_m), chance[part]
        )
        _note(seen, part, hits, found.look)

    in_parallel(job, count, BEAM_GRAIN)
    returned &= range_m >= lidar.min_range_m
    range_m = np.where(returned, (range_m + noise_m).clip(min=0.0), range_m)
    return LidarSweep(
        origin_ego=beams.origin_ego.contiguous(),
        dir_ego=beams.dir_ego,
        range_m=torch.from_numpy(range_m),
        returned=torch.from_numpy(returned),
        intensity=torch.from_numpy(np.where(returned, intensity, np.float32(0.0))),
        dt_s=beams.dt_s,
        beam=lidar.channel,
        valid=torch.ones(count, dtype=torch.bool),
    ), seen


def _to_world(T_world_ego: Float64[np.ndarray, "4 4"], origin: Rays, direction: Rays) -> tuple[Rays, Rays]:
    R = np.ascontiguousarray(T_world_ego[:3, :3].T, dtype=np.float32)
    return origin @ R + T_world_ego[:3, 3].astype(np.float32), direction @ R
