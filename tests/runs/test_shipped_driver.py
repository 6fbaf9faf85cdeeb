"""The driver that comes with the package, in a town."""

from pathlib import Path

import numpy as np
import pytest

from foredrive.runs.drive.agent_inputs import rig_of
from foredrive.runs.drive.in_towns import TownRoutes
from foredrive.runs.drive.suite import DriveSuite, drive_suite


@pytest.mark.slow
def test_it_waits_at_a_red_light_and_reaches_its_goal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    source = TownRoutes("town05-short", only=("12",), rig=rig_of("embedded"))
    (drive,) = drive_suite(DriveSuite("embedded", source, sensors=False), tmp_path / "out").drives.values()
    assert drive.score.completion == 1.0
    assert not drive.score.infractions
    t_s, speed_mps = np.array(drive.track.t_s), np.array(drive.track.speed_mps)
    assert speed_mps.max() > 4.0
    assert (speed_mps[(t_s > 15.0) & (t_s < 27.0)] < 0.3).any()  # the light turns green at 28 s
