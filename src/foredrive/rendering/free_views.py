"""Views that nobody recorded: any camera and any lidar, anywhere, at any time."""

import torch

from foredrive.geometry.se3 import sensor_twist
from foredrive.rendering.rebuilt import SweepPicture
from foredrive.rendering.vehicle import EgoMoment
from foredrive.rendering.views import CameraView, SweepView
from foredrive.scene import CameraRig, LidarSweep
from foredrive.sensors import SpinningLidar


def free_camera(rig: CameraRig, camera: int, moment: EgoMoment, sensor: int | None = None) -> CameraView:
    """A camera whose middle row is exposed at a moment.

    To see what was recorded at a frame, ask for `vehicle.at(t_s + rig.exposed_dt_s[camera])`.

    Args:
        rig: [C]; the vehicle's own, or another with intrinsics, size and places of its own.
        camera: which of the rig.
        moment: where the vehicle is, and when.
        sensor: which learned camera it is like in colour and corrections; None: the `camera`-th, as in the
            vehicle's own rig.
    """
    T_ego_cam = rig.T_ego_cam[camera].to(moment.T_scene_ego)
    return CameraView(
        K=rig.K[camera],
        dist=rig.dist[camera],
        T_scene_cam=moment.T_scene_ego @ T_ego_cam,
        twist_cam=sensor_twist(T_ego_cam, moment.twist_ego),
        t_s=moment.t_s,
        readout_s=float(rig.readout_s[camera]),
        size_hw=rig.size_hw,
        sensor=camera if sensor is None else sensor,
    )


def free_sweep(lidar: SpinningLidar, moment: EgoMoment) -> SweepView:
    """All beams of the revolution that ends at a moment; what they meet is not known yet."""
    twist = moment.twist_ego.cpu()
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
    return SweepView(beams, True, moment.T_scene_ego.cpu(), twist, moment.t_s)


def rendered_sweep(view: SweepView, picture: SweepPicture) -> LidarSweep:
    """The beams of a view with what they met in a scene, in the ego frame of its time."""
    beams, returned = view.beams, picture.returned.cpu()
    return LidarSweep(
        origin_ego=beams.origin_ego,
        dir_ego=beams.dir_ego,
        range_m=picture.hit_range_m.cpu() * returned,
        returned=returned,
        intensity=picture.intensity.cpu() * returned,
        dt_s=beams.dt_s,
        beam=beams.beam,
        valid=beams.valid,
    )
