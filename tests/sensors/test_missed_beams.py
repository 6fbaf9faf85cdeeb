"""What a lidar fired and did not see is found again from what it saw."""

import math

import torch

from foredrive.scene import LidarSweep
from foredrive.sensors import SpinningLidar
from foredrive.sensors.missed_beams import with_missed_beams

TWIST = torch.tensor([8.0, 0.0, 0.0, 0.0, 0.0, 0.3])


def spinning(T_ego_lidar: torch.Tensor) -> SpinningLidar:
    return SpinningLidar(
        elevation_rad=tuple(math.radians(e) for e in (-10.0, -2.0, -1.8, 5.0)),
        azimuth_steps=180,
        rate_hz=10.0,
        min_range_m=0.5,
        max_range_m=100.0,
        range_noise_m=0.0,
        T_ego_lidar=T_ego_lidar,
        firing_s=(0.0, 1e-5, 2e-5, 3e-5),
        azimuth_offset_rad=(0.02, 0.0, -0.02, 0.05),
    )


def test_misses_stand_where_no_beam_returned() -> None:
    T_ego_lidar = torch.eye(4)
    T_ego_lidar[:3, 3] = torch.tensor([1.0, 0.1, 1.9])
    lidar = spinning(T_ego_lidar)
    rays = lidar.beams(TWIST)
    count = len(rays.dt_s)
    returned = torch.rand(count, generator=torch.Generator().manual_seed(0)) > 0.3
    returned[lidar.channel == 3] = False  # a channel that looks at the sky
    seen = LidarSweep(
        rays.origin_ego[returned],
        rays.dir_ego[returned],
        torch.full((count,), 20.0)[returned],
        torch.ones(count, dtype=torch.bool)[returned],
        torch.ones(count)[returned],
        rays.dt_s[returned],
        torch.full((count,), -1)[returned],
        torch.ones(count, dtype=torch.bool)[returned],
    )
    whole = with_missed_beams(seen, lidar, TWIST)
    assert len(whole.dt_s) == count
    assert torch.equal(whole.beam[whole.returned], lidar.channel[returned])
    missed, truth = ~whole.returned, ~returned
    known = lidar.channel[truth] != 3  # of the silent channel only the table is known
    apart = torch.cdist(rays.dir_ego[truth][known], whole.dir_ego[missed]).min(1)
    assert float(apart.values.max()) < 2e-3
    late_s = (whole.dt_s[missed][apart.indices] - rays.dt_s[truth][known]).abs()
    assert float(late_s.max()) < 1e-4
    off_m = (whole.origin_ego[missed][apart.indices] - rays.origin_ego[truth][known]).norm(dim=-1)
    assert float(off_m.max()) < 2e-3
    silent = torch.cdist(rays.dir_ego[truth][~known], whole.dir_ego[missed]).min(1).values
    assert float(silent.max()) < 0.05
