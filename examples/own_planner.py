"""A planner of one's own: foredrive drive --agent python:examples/own_planner.py:Planner --out runs/own."""

import numpy as np


class Planner:
    needs = {"cameras": ["PCAM_F0"], "image_hw": [96, 160], "lidar": True, "past_frames": 1}

    def act(self, clip):  # a foredrive.scene.Clip: images, rig, sweeps, ego_speed_mps, command, route_xy
        points = clip.sweeps[clip.now].points_ego  # m, in the ego frame: x ahead, y left, z up
        near = (points[:, 0] > 4) & (points[:, 1].abs() < 1.2) & (points[:, 2] > 0.4) & (points[:, 2] < 2)
        free_m = float(points[near, 0].min()) - 8 if near.any() else 30.0
        route = np.vstack([[0.0, 0.0], clip.route_xy[clip.route_valid]])  # 2 to 40 m ahead of the vehicle
        along_m = np.cumsum(np.hypot(*np.diff(route, axis=0, prepend=route[:1]).T))
        steps_m = 0.5 * np.clip(free_m / 3, 0, 6) * np.arange(1, 7)  # 0.5 s apart, for 3 s
        return np.stack([np.interp(steps_m, along_m, route[:, axis]) for axis in range(2)], axis=1)
