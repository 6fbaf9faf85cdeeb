"""The towns as Gymnasium environments."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from foredrive.driving.scores import FACTOR_1_0
from foredrive.errors import InputError
from foredrive.integrations.gym.town_env import PENALTY, TownEnv
from foredrive.sensors.rigs import FRONT_TELE
from foredrive.towns.map.names import TOWNS, UNSEEN_TOWNS

NAME = "foredrive.integrations.gym:foredrive/Town02-v0"
GO, STRAIGHT = np.array([0.4, 0.0], np.float32), np.array([1.0, 0.0], np.float32)


def test_each_town_is_there_but_the_unseen_ones() -> None:
    gymnasium.make(NAME)
    names = {name for name in gymnasium.registry if name.startswith("foredrive/")}
    assert names == {f"foredrive/{town}-v0" for town in TOWNS if town not in UNSEEN_TOWNS}


@pytest.mark.filterwarnings("error")
def test_gymnasiums_own_checks_pass() -> None:
    env = gymnasium.make(NAME, render_mode="rgb_array", cameras=FRONT_TELE.of_size((16, 32)))
    check_env(env.unwrapped)


def test_an_episode_gives_its_seed_again() -> None:
    env, told = gymnasium.make(NAME), []
    for _ in range(2):
        first, begun = env.reset(seed=5)
        seen = [first["boxes"]]
        for _ in range(8):
            observation, reward, *_ = env.step(GO)
            seen.append(observation["boxes"])
            assert reward >= 0
        told.append((begun["route"], np.stack(seen), observation["ego"]))
    assert told[0][0] == told[1][0]
    assert np.array_equal(told[0][1], told[1][1])
    assert told[0][2][0] == pytest.approx(0.4 * 4.0 * 0.8, abs=0.25)  # jerk is bounded
    assert np.abs(told[0][1][-1] - told[0][1][0]).max() > 0.5  # others move


def test_progress_is_rewarded_and_leaving_the_route_ends() -> None:
    env = TownEnv("Town02", scenarios=False, stops_at_collision=False)
    env.reset(seed=1)
    total, costs = 0.0, 0.0
    for _ in range(400):
        _, reward, ended, cut, info = env.step(STRAIGHT)
        total += reward
        kinds = [event.kind for event in info["events"]]
        costs += sum(PENALTY * (1 - FACTOR_1_0[kind]) for kind in kinds if kind in FACTOR_1_0)
        if ended or cut:
            break
    assert ended
    assert kinds[-1] == "deviation"
    assert total == pytest.approx(env._simulator.done_m - costs, abs=1e-6)
    assert 0 < info["completion"] < 1


def test_a_vector_of_towns_begins_anew_in_the_next_step() -> None:
    made = [lambda: gymnasium.make(NAME, max_episode_steps=3) for _ in range(2)]
    envs = SyncVectorEnv(made, autoreset_mode=AutoresetMode.NEXT_STEP)
    envs.reset(seed=3)
    for _ in range(3):
        observation, _, _, cut, _ = envs.step(np.stack([GO, GO]))
    assert cut.all()
    assert (observation["ego"][:, 0] > 0.1).all()
    observation, reward, _, cut, _ = envs.step(np.stack([GO, GO]))
    assert not cut.any()
    assert (reward == 0).all()
    assert (observation["ego"][:, 0] == 0).all()


def test_what_cannot_be_driven_is_refused() -> None:
    with pytest.raises(InputError, match="no route in Town02"):
        TownEnv("Town02", routes="town05-short")
    with pytest.raises(InputError, match="multiple of 2"):
        TownEnv("Town02", skip=3)
    with pytest.raises(InputError, match="no route x; there are"):
        TownEnv("Town02").reset(seed=0, options={"route": "x"})


@pytest.mark.slow
def test_stable_baselines3_learns_to_drive_in_about_a_minute() -> None:
    """Untrained, the policy stands; trained, it gets on along the route."""
    library = pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed")
    env = TownEnv("Town02", scenarios=False, skip=4)
    model = library.PPO(
        "MultiInputPolicy", env, n_steps=512, batch_size=128, gamma=0.97, seed=0, device="cpu"
    )

    def driven_m() -> float:
        observation, _ = env.reset(seed=3)
        for _ in range(100):
            action, _ = model.predict(observation, deterministic=True)
            observation, _, ended, cut, _ = env.step(action)
            if ended or cut:
                break
        return float(env._simulator.done_m)

    before_m = driven_m()
    model.learn(6 * 512)
    assert driven_m() > before_m + 10.0
