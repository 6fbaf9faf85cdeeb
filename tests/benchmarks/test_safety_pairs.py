"""Agreement of paired safety tests, worked out by hand, and the town's sensors in a replayed drive."""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.common.reconstructed_towns import FRONT, TownDrive, TownTruth
from benchmarks.common.safety_agreement import agreement, control_variate, majority_agreement
from benchmarks.common.safety_pairs import Driven, NoisyAgent, Pair, SensorNoise, outline
from benchmarks.common.safety_suites import spread
from benchmarks.common.town_replay import TownReplayRenderer
from foredrive.driving.ncap.scenario import Polyline, SafetyScenario, ScenarioActor
from foredrive.driving.observation import HORIZON_STEPS
from foredrive.driving.replay.threats import Threat
from foredrive.driving.simple_agents import plan_of
from foredrive.errors import InputError
from foredrive.methods.reconstruction.tracks import ActorTracks
from foredrive.scene import Clip, Example, Trajectory, VoxelSpec


def driven(outcome: str, score: float | None, near_m: float = 0.0, lost_db: float = 0.0) -> Driven:
    return Driven(outcome, score, 0.5, near_m, 1.0, lost_db, 25.0, 24.0)


def test_agreement_by_hand() -> None:
    pairs = [
        Pair("side", "a", "one", driven("passed", 5.0, 3.0), driven("passed", 5.0, 2.0)),
        Pair("side", "b", "one", driven("collided", 1.0), driven("collided", 2.0)),
        Pair("frontal", "c", "two", driven("collided", 2.0), driven("stopped_short", 5.0, 1.0, 9.0)),
        Pair("frontal", "a", "two", driven("failed", None), driven("collided", 0.0)),
    ]
    figures = agreement(pairs)
    assert (figures["pairs"], figures["failed"], figures["tests"]) == (3, 1, 2)
    assert figures["collision_agreement"] == pytest.approx(2 / 3)
    # By chance, 2/3 and 1/3 collisions agree in 2/3 * 1/3 + 1/3 * 2/3
    assert figures["kappa"] == pytest.approx((2 / 3 - 4 / 9) / (5 / 9))
    assert figures["score_difference"] == pytest.approx((0 + 1 + 3) / 3)
    assert figures["score_bias"] == pytest.approx((0 + 1 + 3) / 3)
    town, reconstructed = np.array([5.0, 1.0, 2.0]), np.array([5.0, 2.0, 5.0])
    assert figures["score_correlation"] == pytest.approx(np.corrcoef(town, reconstructed)[0, 1])
    assert figures["min_distance_difference_m"] == 1.0
    # Agents a, b, c: the town ranks a > c > b, the reconstruction a = c > b
    assert figures["rank_correlation"] == pytest.approx(np.corrcoef([2, 0, 1], [1.5, 0, 1.5])[0, 1])
    assert (figures["agreement_trusted"], figures["agreement_untrusted"]) == (1.0, 0.0)
    assert figures["trusted_pairs"] == pytest.approx(2 / 3)
    assert figures["auc_disagreement"] == 1.0
    assert figures["calibration_error_db"] == 1.0


def test_the_majority_is_that_of_other_tests() -> None:
    """Three of four end in a collision: without itself, each of the three has two of three with it."""
    ends = [driven("collided", 1.0)] * 3 + [driven("passed", 5.0)]
    pairs = [Pair("side", "a", str(number), end, end) for number, end in enumerate(ends)]
    assert majority_agreement(pairs) == 0.75
    # Two that differ predict each other wrongly
    assert majority_agreement(pairs[2:]) == 0.0


def test_intervals_draw_whole_places() -> None:
    """All pairs of a place agree or all disagree, so that half of ten places is known as ten coins are."""
    pairs = [
        Pair(
            "side",
            agent,
            f"T/side-a_{number}s_{impact_s}s_3mps",
            driven("collided", 1.0),
            driven(end, 1.0),
        )
        for number, end in enumerate(["collided", "passed"] * 5)
        for agent in ("a", "b")
        for impact_s in (2, 3)
    ]
    figures = agreement(pairs)
    assert figures["collision_agreement"] == 0.5
    low, high = (figures[f"collision_agreement_{end}"] for end in ("low", "high"))
    # Binomial with 10 draws: 2.5 % and 97.5 % at 0.2 and 0.8; with 20 draws they would be 0.3 and 0.7
    assert (low, high) == (pytest.approx(0.2, abs=0.01), pytest.approx(0.8, abs=0.01))


def test_where_all_pairs_agree_the_bound_is_exact() -> None:
    """68 of 68: the share p of which all 68 agree in 2.5 % of cases is 0.025 ** (1 / 68)."""
    ends = [driven("collided", 1.0), driven("passed", 5.0)] * 34
    figures = agreement([Pair("side", "a", str(number), end, end) for number, end in enumerate(ends)])
    assert (figures["kappa"], figures["places"]) == (1.0, 68.0)
    assert not {"kappa_low", "kappa_high"} & figures.keys()
    assert figures["collision_agreement_low"] == pytest.approx(0.025 ** (1 / 68))
    assert figures["collision_agreement_high"] == 1.0


def test_the_reconstruction_reduces_the_error_of_few_true_drives() -> None:
    rng = np.random.default_rng(1)
    town = rng.normal(2.5, 1.0, 600)
    for noise, ratio in ((0.0, 0.0), (1.0, 0.5)):
        # Correlation ρ² = 1 / (1 + noise²) leaves a share 1 - ρ² of the variance
        scores = np.stack([town, town + rng.normal(0, 1, 600) * noise + 1.0], axis=1)
        figures = control_variate(scores, np.random.default_rng(2))
        assert figures["control_variate_error_ratio"] == pytest.approx(ratio, abs=0.07)
        assert abs(figures["control_variate_bias"]) < 0.02
    assert control_variate(scores[:10], rng) == {}


def test_without_spread_there_is_no_correlation_and_without_pairs_nothing() -> None:
    same = [Pair("side", "a", "one", driven("passed", 5.0, 1.0), driven("passed", 5.0, 2.0))] * 3
    figures = agreement(same)
    assert figures["collision_agreement"] == 1.0
    assert not {"score_correlation", "kappa", "rank_agreement"} & set(figures)
    assert agreement([]) == {"pairs": 0.0, "failed": 0.0}


class _Kept:
    """An agent that keeps its observations and stands."""

    def __init__(self) -> None:
        self.observations: list[Clip] = []

    def act(self, observation: Clip) -> Trajectory:
        self.observations.append(observation)
        return plan_of(torch.zeros(1, 1, HORIZON_STEPS, 2))


def test_noise_of_a_key_frame_stays_and_is_the_same_in_both_worlds(
    make_example: Callable[..., Example],
) -> None:
    spec = VoxelSpec((-4.0, -4.0, -1.0), 4.0, (1, 2, 2))
    sighted = make_example(spec=spec, past=1).clip
    sweeps = sighted.sweeps.map_tensors(lambda of: of.new_ones(*of.shape[:2], 400, *of.shape[3:]))
    sighted = dataclasses.replace(sighted, images=torch.full_like(sighted.images, 128), sweeps=sweeps)
    noise = SensorNoise(pixel_std=30.0, lost_beams=0.5)
    shown = []
    for _ in range(2):
        agent = _Kept()
        noisy = NoisyAgent(agent, noise, seed=4)
        noisy.act(sighted)
        noisy.act(sighted)
        shown.append(agent.observations)
    (first, second), again = shown
    assert torch.equal(second.images, again[1].images)
    # The newest frame of the first plan is the one before the newest of the second
    now = sighted.now
    change = first.images[:, now].float() - 128
    assert float(change.std()) == pytest.approx(30.0, rel=0.1)
    assert torch.equal(second.images[:, now - 1], first.images[:, now])
    assert not torch.equal(second.images[:, now], first.images[:, now])
    assert float(first.sweeps.valid[:, : now + 1].float().mean()) == pytest.approx(0.5, abs=0.1)
    assert bool(sighted.sweeps.valid.all())


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
    assert {"all", "Town03", "corridor", "side"} <= set(ncap_transfer.BENCHMARK.arms)
    assert Path("runs") in ncap.WORK.parents
