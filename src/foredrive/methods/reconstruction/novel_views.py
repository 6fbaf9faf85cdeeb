"""Views that were not recorded: any camera and any lidar, anywhere, at any time."""

import dataclasses

import torch

from foredrive.geometry.se3 import sensor_twist
from foredrive.methods.reconstruction.rendered import RenderedSweep
from foredrive.methods.reconstruction.vehicle import EgoState
from foredrive.methods.reconstruction.views import CameraView, SweepView
from foredrive.scene import CameraRig, LidarSweep
from foredrive.sensors import SpinningLidar


def novel_camera_view(rig: CameraRig, camera: int, ego: EgoState, sensor: int | None = None) -> CameraView:
    """Return a camera whose middle row is exposed at a given state of the ego vehicle.

    For the view recorded at a frame, use `vehicle.at(t_s + rig.exposed_dt_s[camera])`.

    Args:
        rig: [C]; the vehicle's own, or one with other intrinsics, size and places.
        camera: index in the rig.
        ego: pose and time of the vehicle.
        sensor: index of the learned camera whose colours and corrections are used. None: `camera`, as in the
            vehicle's own rig.
    """
    T_ego_cam = rig.T_ego_cam[camera].to(ego.T_scene_ego)
    return CameraView(
        K=rig.K[camera],
        dist=rig.dist[camera],
        T_scene_cam=ego.T_scene_ego @ T_ego_cam,
        twist_cam=sensor_twist(T_ego_cam, ego.twist_ego),
        t_s=ego.t_s,
        readout_s=float(rig.readout_s[camera]),
        size_hw=rig.size_hw,
        sensor=camera if sensor is None else sensor,
    )


def novel_sweep_view(lidar: SpinningLidar, ego: EgoState) -> SweepView:
    """Return all beams of the revolution that ends at a state of the ego vehicle, without ranges."""
    twist = ego.twist_ego.cpu()
    # Beams of one revolution, each from where the lidar is at its time
    rays = lidar.beams(twist)
    zero = torch.zeros_like(rays.dt_s)
    beams = LidarSweep(
        origin_ego=rays.origin_ego,
        dir_ego=rays.dir_ego,
        range_m=zero,
        returned=torch.zeros_like(zero, dtype=torch.bool),
        intensity=zero,
        dt_s=rays.dt_s,
        beam=lidar.channel,
        valid=torch.ones_like(zero, dtype=torch.bool),
    )
    # The sweep is complete in that it holds lost beams too, here all beams
    return SweepView(beams, True, ego.T_scene_ego.cpu(), twist, ego.t_s)


def rendered_sweep(view: SweepView, picture: RenderedSweep) -> LidarSweep:
    """Return the beams of a view with rendered ranges and intensities, in the ego frame at its time."""
    beams, returned = view.beams, picture.returned.cpu()
    return dataclasses.replace(
        beams,
        range_m=picture.hit_range_m.cpu() * returned,
        returned=returned,
        intensity=picture.intensity.cpu() * returned,
    )
