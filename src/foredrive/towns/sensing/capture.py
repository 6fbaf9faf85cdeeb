"""Simulated camera images and lidar sweeps of a town at one moment."""

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int64, UInt8

from foredrive.geometry.se3 import exp_se3
from foredrive.ops.threads import in_parallel
from foredrive.scene import CameraRig, LidarSweep
from foredrive.sensors import CameraOptics, SpinningLidar, camera_rays
from foredrive.sensors.vehicle import VehicleSensors
from foredrive.towns.sensing import echoes, shading
from foredrive.towns.sensing import wet as wet_ground
from foredrive.towns.sensing.beams import add_beams
from foredrive.towns.sensing.hit_buffer import HitBuffer, empty_hit_buffer, record_hits
from foredrive.towns.sensing.lidar_returns import air_returns, lidar_returns
from foredrive.towns.sensing.light import LightArrays
from foredrive.towns.sensing.outlines import ShadedPixels, outlines, same_as_centre
from foredrive.towns.sensing.raycast import RaycastScene

PIXEL_GRAIN, BEAM_GRAIN = 4096, 4096

NOT_KNOWN = np.empty((0, 3), np.float32)

Rays = Float32[np.ndarray, "N 3"]
Times = Float32[np.ndarray, "N"]


class EgoRays(NamedTuple):
    """Rays in the ego frame of the time at which each of them is measured."""

    origin: Rays
    direction: Rays
    dt_s: Times
    """Time relative to the frame's time, s."""


@dataclass(frozen=True)
class SensorSuite(VehicleSensors):
    """The sensors of the recording vehicle, with the way in which a town's renderer samples them."""

    samples_per_outline_pixel: int = 4
    """Number of rays of an outline pixel, a square number. Other pixels have one ray, because textures are
    filtered. Pixels with an outline or a shadow edge have this many."""
    optics: CameraOptics = field(default_factory=CameraOptics)

    @cached_property
    def pixel_rays(self) -> EgoRays:
        """Return the central rays of the pixels, ordered by camera, row and column."""
        return _flat_rays(self.rig, 1)

    @cached_property
    def outline_rays(self) -> EgoRays:
        """Return the rays of the pixels for outlines, with the rays of one pixel next to each other."""
        return _flat_rays(self.rig, self.samples_per_outline_pixel)

    @cached_property
    def pixel_rad(self) -> Float32[np.ndarray, "P"]:
        """Return the angle between neighbouring pixels at each pixel, rad."""
        height, width = self.rig.size_hw
        # A pixel's width over the focal length
        return (1.0 / self.rig.K[:, 0, 0]).repeat_interleave(height * width).numpy()


def _flat_rays(rig: CameraRig, samples: int) -> EgoRays:
    rays = camera_rays(rig, samples)
    origin, direction = rays.origin_ego.reshape(-1, 3).numpy(), rays.dir_ego.reshape(-1, 3).numpy()
    return EgoRays(origin, direction, rays.dt_s.flatten().numpy())


class WorldRays(NamedTuple):
    """Rays in the world frame."""

    origin: Rays
    direction: Rays
    dt_s: Times | None
    """Time of each ray relative to the frame's time, s; None: all at that time."""


@dataclass(frozen=True)
class EgoMotion:
    """The pose of the vehicle at the frame's time, and its motion around that time."""

    T_world_ego: Float64[np.ndarray, "4 4"]
    twist_ego: Float[np.ndarray, "6"]
    """Velocity (m/s), then turn rate (rad/s), of the ego frame in its own axes."""

    def to_world(self, rays: EgoRays, rows: Int64[np.ndarray, "n"]) -> WorldRays:
        """Transform the rays `rows` from the ego frame of the frame's time to the world, all at that time."""
        T = np.ascontiguousarray(self.T_world_ego[:3], dtype=np.float32)
        origin, direction = shading.transform_rays(T, rays.origin, rays.direction, rows)
        return WorldRays(origin, direction, None)

    def to_world_at_ray_times(self, rays: EgoRays) -> WorldRays:
        """Transform rays from the ego frame of the time at which each of them is measured to the world."""
        # A vehicle at rest has the same pose at all times; the others may still move
        if not self.twist_ego.any():
            return self.to_world(rays, np.arange(len(rays.dt_s)))._replace(dt_s=rays.dt_s)
        # Rays of one row share their time: compute each pose once
        dt_s, row = np.unique(rays.dt_s, return_inverse=True)
        T_now_then = exp_se3(torch.from_numpy(dt_s[:, None].astype(np.float64) * self.twist_ego)).numpy()
        T = (self.T_world_ego @ T_now_then)[:, :3].astype(np.float32)[row]
        origin = np.einsum("nij,nj->ni", T[..., :3], rays.origin) + T[..., 3]
        return WorldRays(origin, np.einsum("nij,nj->ni", T[..., :3], rays.direction), rays.dt_s)


@dataclass(frozen=True)
class RayTracer:
    """A town with its road users at their positions at one time, and their motion around that time."""

    scene: shading.SceneArrays
    surroundings: RaycastScene
    light: LightArrays

    def cast(self, rays: WorldRays) -> shading.Hits:
        """Return the nearest hits."""
        return self.surroundings.cast(*rays)

    def trace(
        self, rays: WorldRays, ray_rad: Float32[np.ndarray, "N"]
    ) -> tuple[shading.Hits, shading.Surfaces, Bool[np.ndarray, "N"]]:
        """Return the hits of rays, the surfaces there, and whether the sun shines there.

        `ray_rad` is the angle between neighbouring rays, rad.
        """
        # Hits, then surfaces there, then shadows: one ray to the sun for each surface that faces it
        hits = self.cast(rays)
        surfaces = shading.surfaces(self.scene, hits, rays.origin, rays.direction, ray_rad)
        return hits, surfaces, self.sunlit(surfaces, hits, rays.dt_s)

    def radiance(
        self,
        hits: shading.Hits,
        surfaces: shading.Surfaces,
        lit: Bool[np.ndarray, "N"],
        rays: WorldRays,
        ray_rad: Float32[np.ndarray, "N"],
        given: Float32[np.ndarray, "M 3"] = NOT_KNOWN,
    ) -> Rays:
        """Return the radiance along rays.

        Where `known` is not negative, it is the result. It may have no rows.
        """
        mirrored = self.mirrored(surfaces, hits, rays, ray_rad)
        materials, light = self.scene.materials, self.light
        out = shading.shade(materials, surfaces, hits.t, rays.direction, lit, light, mirrored, given)
        if light.air.foggy and len(light.lamps.lamp_index) > 0:
            # Rays into the sky pass all fog lamps: their end is at infinity
            t = np.where(surfaces.material == shading.MISS, np.float32(np.inf), hits.t)
            add_beams(light.lamps, light.air.extinction_per_m, t, rays.origin, rays.direction, given, out)
        return out

    def sunlit(
        self, surfaces: shading.Surfaces, hits: shading.Hits, dt_s: Times | None
    ) -> Bool[np.ndarray, "N"]:
        """Return whether the sun shines on each hit."""
        start = np.empty_like(surfaces.xyz)
        facing = shading.sun_rays(surfaces, hits.t, self.light.sun, start)
        to_sun = np.ascontiguousarray(np.broadcast_to(self.light.sun, (len(facing), 3)))
        lit = np.zeros(len(hits.t), dtype=np.bool_)
        when = None if dt_s is None else dt_s[facing]
        lit[facing] = ~self.surroundings.occluded(start[: len(facing)], to_sun, when)
        return lit

    def mirrored(
        self,
        surfaces: shading.Surfaces,
        hits: shading.Hits,
        rays: WorldRays,
        ray_rad: Float32[np.ndarray, "N"],
    ) -> Float32[np.ndarray, "M 3"]:
        """Return the radiance that water on the ground mirrors, -1 where there is no water.

        The result has no rows if the ground is dry.
        """
        if self.light.air.wetness == 0.0:
            return NOT_KNOWN
        # One more ray for each hit on water that mirrors enough; it is shaded without further mirrors
        out = np.full((len(hits.t), 3), -1.0, np.float32)
        origin, direction = np.empty_like(out), np.empty_like(out)
        wetness, materials = self.light.air.wetness, self.scene.materials
        wet = wet_ground.mirror_rays(materials, surfaces, hits.t, rays.direction, wetness, origin, direction)
        dt_s = None if rays.dt_s is None else rays.dt_s[wet]
        mirrored_rays = WorldRays(origin[: len(wet)], direction[: len(wet)], dt_s)
        met, mirrored_surfaces, lit = self.trace(mirrored_rays, ray_rad[wet])
        out[wet] = shading.shade(
            materials,
            mirrored_surfaces,
            met.t,
            mirrored_rays.direction,
            lit,
            self.light,
            NOT_KNOWN,
            NOT_KNOWN,
        )
        return out


class Film:
    """The light on the pixels of all cameras, from radiance to 8-bit images."""

    def __init__(self, optics: CameraOptics, metered: float, count: int) -> None:
        self._optics, self._exposure = optics, metered * 2.0**optics.exposure_ev
        self._rgb = np.empty((count, 3), np.uint8)
        noisy = not math.isinf(optics.white_electrons)
        self._linear = np.empty((count, 3), np.float32) if noisy else None

    def expose(self, pixels: slice | Int64[np.ndarray, "n"], radiance: Rays, samples: int) -> None:
        """Set the light of pixels, from `samples` rays for each."""
        # Without noise the pixels are developed at once; noise needs all linear values first
        if self._linear is None:
            self._rgb[pixels] = shading.develop(radiance, self._exposure, samples)
        else:
            self._linear[pixels] = self._exposure * radiance.reshape(-1, samples, 3).mean(1)

    @property
    def noise_free(self) -> UInt8[np.ndarray, "P 3"]:
        """Return the present colours of the pixels, without sensor noise."""
        return self._rgb if self._linear is None else shading.develop(self._linear, 1.0, 1)

    def develop(self, rng: np.random.Generator) -> UInt8[np.ndarray, "P 3"]:
        """Return the colours of the pixels, with sensor noise if the cameras have any."""
        if self._linear is None:
            return self._rgb
        return shading.develop(self._optics.with_noise(self._linear, rng), 1.0, 1)


def render_images(
    tracer: RayTracer, sensors: SensorSuite, ego: EgoMotion, rng: np.random.Generator
) -> tuple[UInt8[np.ndarray, "C H W 3"], HitBuffer]:
    """Render images of all cameras.

    Also return the hits of the pixels' central rays [C·H·W] in the middle of their exposure. Each row is
    rendered from the pose of the vehicle at its readout time. The road users are at their positions at that
    time; they move straight ahead.
    """
    shape = (len(sensors.rig.names), *sensors.rig.size_hw)
    count = int(np.prod(shape))
    buffer, film = empty_hit_buffer(count), Film(sensors.optics, tracer.light.exposure, count)
    if sensors.optics.shutter_s > 0:
        _render_blurred(tracer, sensors, ego, film, buffer)
    else:
        _render_sharp(tracer, sensors, ego, film, buffer)
    return film.develop(rng).reshape(*shape, 3), buffer


def _render_sharp(
    tracer: RayTracer, sensors: SensorSuite, ego: EgoMotion, film: Film, buffer: HitBuffer
) -> None:
    """Render one ray per pixel, then several rays for pixels on outlines."""
    count, samples = len(buffer.material), sensors.samples_per_outline_pixel
    rolling = bool(sensors.rig.readout_s.any())
    rgb, normal = np.empty((count, 3), np.float32), np.empty((count, 3), np.float32)
    shaded = ShadedPixels(rgb, normal, np.empty(count, np.bool_))

    # Rows of a rolling shutter have their own times; else one pose serves all rays
    def to_world(rays: EgoRays, rows: Int64[np.ndarray, "n"]) -> WorldRays:
        return (
            ego.to_world_at_ray_times(EgoRays(*(column[rows] for column in rays)))
            if rolling
            else ego.to_world(rays, rows)
        )

    def trace_centres(start: int, stop: int) -> None:
        part = slice(start, stop)
        rays = to_world(sensors.pixel_rays, np.arange(start, stop))
        hits, surfaces, lit = tracer.trace(rays, sensors.pixel_rad[part])
        radiance = tracer.radiance(hits, surfaces, lit, rays, sensors.pixel_rad[part])
        film.expose(part, radiance, 1)
        record_hits(buffer, part, hits, surfaces.material)
        shaded.radiance[part], shaded.normal[part], shaded.lit[part] = radiance, surfaces.normal, lit

    # First pass: one ray through each pixel's centre
    in_parallel(trace_centres, count, PIXEL_GRAIN)
    if samples == 1:
        return
    shape = (len(sensors.rig.names), *sensors.rig.size_hw)
    # Second pass: several rays for the pixels on edges, with correspondingly smaller footprints
    pixels = np.flatnonzero(outlines(buffer, shaded, film.noise_free, shape))

    def trace_outlines(start: int, stop: int) -> None:
        some = pixels[start:stop]
        rows = (some[:, None] * samples + np.arange(samples)).ravel()
        rays = to_world(sensors.outline_rays, rows)
        ray_rad = np.repeat(sensors.pixel_rad[some], samples) / np.float32(samples**0.5)
        hits, surfaces, lit = tracer.trace(rays, ray_rad)
        # Rays that find the same as the centre take its result instead of being shaded
        same = same_as_centre(some, samples, surfaces, hits.actor, lit, buffer, shaded)
        film.expose(some, tracer.radiance(hits, surfaces, lit, rays, ray_rad, same), samples)

    in_parallel(trace_outlines, len(pixels), PIXEL_GRAIN // samples)


def _render_blurred(
    tracer: RayTracer, sensors: SensorSuite, ego: EgoMotion, film: Film, buffer: HitBuffer
) -> None:
    """Render the mean of the light at several instants, each through a different part of the pixel."""
    optics, samples = sensors.optics, sensors.samples_per_outline_pixel

    def job(start: int, stop: int) -> None:
        part = slice(start, stop)
        # The buffer for labels has the hits in the middle of the exposure
        rays = ego.to_world_at_ray_times(EgoRays(*(column[part] for column in sensors.pixel_rays)))
        hits = tracer.cast(rays)
        ray_rad = sensors.pixel_rad[part]
        surfaces = shading.surfaces(tracer.scene, hits, rays.origin, rays.direction, ray_rad)
        record_hits(buffer, part, hits, surfaces.material)
        total = np.zeros((stop - start, 3), np.float32)
        # Each instant uses another of the pixel's sub-positions, so that edges are smooth too
        for k, dt_s in enumerate(optics.sub_exposure_dt_s):
            origin, direction, row_dt_s = sensors.outline_rays
            rows = slice(start * samples + k % samples, stop * samples, samples)
            rays = ego.to_world_at_ray_times(
                EgoRays(origin[rows], direction[rows], row_dt_s[rows] + np.float32(dt_s))
            )
            total += tracer.radiance(*tracer.trace(rays, ray_rad), rays, ray_rad)
        film.expose(part, total / np.float32(optics.sub_exposures), 1)

    in_parallel(job, len(buffer.material), PIXEL_GRAIN)


def simulate_sweep(
    tracer: RayTracer, lidar: SpinningLidar, ego: EgoMotion, rng: np.random.Generator
) -> tuple[LidarSweep, HitBuffer]:
    """Simulate one revolution of the lidar, and return the sweep and the hits of its beams.

    Road users move straight ahead during the revolution. A beam without a return is free up to the surface
    that it hit.
    """
    # All beams of a revolution, each with its own firing time and the vehicle's pose then
    beams = lidar.beams(torch.from_numpy(np.asarray(ego.twist_ego, dtype=np.float32)))
    rays, n = lidar.footprints(beams), lidar.rays_per_beam
    ego_rays = EgoRays(rays.origin_ego.numpy(), rays.dir_ego.numpy(), rays.dt_s.numpy())
    count = len(beams.dt_s)
    # Random numbers are drawn for all beams at once: the result does not depend on threads
    chance = rng.random((count, 2), dtype=np.float32)
    noise_m = rng.standard_normal(count, dtype=np.float32) * np.float32(lidar.range_noise_m)
    range_m, intensity = np.empty(count, np.float32), np.empty(count, np.float32)
    returned = np.empty(count, np.bool_)
    buffer, air, far_m = empty_hit_buffer(count), tracer.light.air, np.float32(lidar.max_range_m)
    clutter = rng.random((count if air.backscatter_per_m_sr > 0 else 0, 4), dtype=np.float32)
    # Angle between neighbouring rays, for the filter of textures
    beam_rad = np.float32(2 * np.pi / lidar.azimuth_steps if n == 1 else lidar.divergence_rad / n**0.5)

    def job(start: int, stop: int) -> None:
        part, rows = slice(start, stop), np.arange(start * n, stop * n)
        rays = ego.to_world(ego_rays, rows)._replace(dt_s=ego_rays.dt_s[rows])
        hits = tracer.cast(rays)
        ray_rad = np.full(len(hits.t), beam_rad)
        hit_surfaces = shading.surfaces(tracer.scene, hits, rays.origin, rays.direction, ray_rad)
        odds = chance[part]
        # Rays of one beam that end within a pulse's depth form one echo
        if n > 1:
            t = np.where(hit_surfaces.material == shading.MISS, np.inf, hits.t).reshape(-1, n)
            group, share = echoes.group_echoes(t, lidar.pulse_m)
            # Returns of the surfaces; then one echo for each beam
            odds = echoes.footprint_chance(odds, share)
        material = hit_surfaces.material
        echo = lidar_returns(tracer.scene.materials, hit_surfaces, hits.t, far_m, odds, air)
        if n > 1:
            echo, picked = echoes.pick_echo(group, echo, lidar.echo == "last")
            hits, material = shading.Hits(*(column[picked] for column in hits)), material[picked]
        range_m[part], returned[part], intensity[part] = echo
        record_hits(buffer, part, hits, material)
        # Fog and rain may return the pulse before the surface does
        if len(clutter):
            surfaces = range_m[part], returned[part], intensity[part]
            of_air = air_returns(air, clutter[part], lidar.pulse_m, far_m, *surfaces)
            # An echo of the air has no surface: its labels are those of a miss
            buffer.triangle[part][of_air], buffer.material[part][of_air] = shading.MISS, shading.MISS

    in_parallel(job, count, BEAM_GRAIN // n)
    # Too close returns are lost; range noise is added to what is left
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
    ), buffer
