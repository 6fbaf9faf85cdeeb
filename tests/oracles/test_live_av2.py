"""Parity of motion forecasts with av2 as it is installed: `make test-oracles`. The seeds are others."""

import pytest
from oracles.av2_forecasting import (
    check_forecasting,
    check_single_agents,
    forecasting_of_av2,
    forecasting_scene,
    single_agents,
    single_agents_of_av2,
)

pytestmark = [pytest.mark.oracle, pytest.mark.filterwarnings("ignore")]


@pytest.mark.parametrize("seed", [20, 21, 22])
def test_forecasts(seed: int) -> None:
    agents, scene = single_agents(seed), forecasting_scene(seed)
    check_single_agents(*agents, single_agents_of_av2(*agents))
    check_forecasting(*scene, forecasting_of_av2(*scene))
