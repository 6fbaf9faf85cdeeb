"""Agreement of paired safety tests, worked out by hand, and the town's sensors in a replayed drive."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.common.reconstructed_towns import FRONT, TownDrive, TownTruth
from benchmarks.common.safety_pairs import Driven, Pair, agreement, outline, read_pair
from benchmarks.common.safety_suites import spread
from foredrive.driving.ncap.scenario import Polyline, SafetyScenario, ScenarioActor
from foredrive.driving.replay.threats import Threat
from foredrive.errors import InputError
from foredrive.methods.reconstruction.tracks import ActorTracks
from foredrive.towns.driving.town_replay import TownReplayRenderer


def driven(outcome: str, score: float | None, near_m: float = 0.0) -> Driven:
    return Driven(outcome, score, 0.5, near_m)


def test_agreement_by_hand() -> None:
    pairs = [
        Pair("side", driven("passed", 5.0, 3.0), driven("passed", 5.0, 2.0)),
        Pair("side", driven("collided", 1.0), driven("collided", 2.0)),
        Pair("frontal", driven("collided", 2.0), driven("stopped_short", 5.0, 1.0)),
        Pair("frontal", driven("failed", None), driven("collided", 0.0)),
    ]
    found = agreement(pairs)
    assert (found["pairs"], found["failed"]) == (3, 1)
    assert found["collision_agreement"] == pytest.approx(2 / 3)
    assert found["score_difference"] == pytest.approx((0 + 1 + 3) / 3)
    town, reconstructed = np.array([5.0, 1.0, 2.0]), np.array([5.0, 2.0, 5.0])
    assert found["score_correlation"] == pytest.approx(np.corrcoef(town, reconstructed)[0, 1])
    assert found["min_distance_difference_m"] == 1.0
    assert read_pair(dataclasses.asdict(pairs[2])) == pairs[2]


def test_without_spread_there_is_no_correlation_and_without_pairs_nothing() -> None:
    same = [Pair("side", driven("passed", 5.0, 1.0), driven("passed", 5.0, 2.0))] * 3
    found = agreement(same)
    assert found["collision_agreement"] == 1.0
    assert "score_correlation" not in found
    assert agreement([]) == {"pairs": 0.0, "failed": 0.0}


def test_outlines_turn_with_the_heading() -> None:
    box = outline(np.array([10.0, 5.0]), 0.5 * math.pi, np.array([2.0, 1.0]))
    assert box.bounds == pytest.approx((9.0, 3.0, 11.0, 7.0))


def test_chosen_scenarios_are_spread_over_the_log() -> None:
    actor = ScenarioActor(("1",), Polyline((0.0, 1.0), ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))))
    found = [SafetyScenario(str(k), Threat.SIDE, "s", k, 8.0, (actor,)) for k in range(8)]
    assert [scenario.name for scenario in spread(found, 4)] == ["0", "2", "5", "7"]
    assert spread(found[:3], 4) == found[:3]


@pytest.fixture(scope="module")
def truth() -> TownTruth:
    drive = TownDrive("Town02", 3, 2.0, rate_hz=2.0, rig=FRONT.of_size((48, 80)), lidar="vlp16")
    return TownTruth(drive)


def test_the_town_shows_an_added_actor_where_its_track_is(truth: TownTruth) -> None:
    moment = truth.snapshots[2]
    T_world_scene = torch.from_numpy(truth.snapshots[0].T_world_ego)
    model = next(actor for actor in truth.world.parked)
    ahead = moment.T_world_ego @ np.array([[1, 0, 0, 11.0], [0, 1, 0, 0], [0, 0, 1, 0.8], [0, 0, 0, 1]])
    T = (np.linalg.inv(truth.snapshots[0].T_world_ego) @ ahead)[None, None].repeat(4, 1)
    tracks = ActorTracks(
        torch.tensor([77]),
        torch.tensor([int(model.category)]),
        torch.from_numpy(model.size_lwh[None]).float(),
        torch.tensor([0.0, 0.5, 1.0, 1.5]),
        torch.from_numpy(T).float(),
        torch.ones(1, 4, dtype=torch.bool),
    )
    at = torch.from_numpy(moment.T_world_ego), torch.from_numpy(moment.twist_ego).float(), moment.t_s
    there = (truth.world, truth.drive.sensors, truth.snapshots)
    alone = TownReplayRenderer(*there, tracks, T_world_scene, {}).render(*at)
    added = TownReplayRenderer(*there, tracks, T_world_scene, {77: model.track_id})
    with_it = added.render(*at)
    sensors = truth.drive.sensors
    direct = truth.world.render(
        moment.actors, sensors, moment.T_world_ego, moment.twist_ego, 2, moment.lights
    )
    assert torch.equal(alone.images[0].permute(1, 2, 0), torch.from_numpy(direct.images["PCAM_F0"]))
    assert not torch.equal(alone.images, with_it.images)
    assert with_it.sweep is not None
    points = with_it.sweep.points_ego[with_it.sweep.returned]
    rear_m = 11.0 - 0.5 * float(model.size_lwh[0])
    on_it = (points[:, 1].abs() < 0.9) & (points[:, 0] > rear_m - 1.0) & (points[:, 2] > 0.3)
    assert float(points[on_it & (points[:, 0] < 12.0), 0].min()) == pytest.approx(rear_m, abs=0.7)
    with pytest.raises(InputError, match=r"no moment at 0\.3 s"):
        added.render(*at[:2], 0.3)
    with pytest.raises(InputError, match="no actors"):
        TownReplayRenderer(*there, tracks, T_world_scene, {77: -5})


def test_the_benchmarks_can_be_loaded() -> None:
    from benchmarks import ncap, ncap_transfer

    assert "nemo_cameras@Town03" in ncap.BENCHMARK.arms
    assert {"all", "corridor_lidar_side"} <= set(ncap_transfer.BENCHMARK.arms)
    assert Path("runs") in ncap.WORK.parents
