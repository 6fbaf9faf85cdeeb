"""The benchmark of failing inputs."""

import pytest

from benchmarks import drive_robustness
from foredrive.errors import InputError


def test_a_camera_that_the_agent_lacks_cannot_fail(monkeypatch: pytest.MonkeyPatch) -> None:
    """The surround rig has no narrow camera, so an arm in which it fails would repeat the untouched one."""
    monkeypatch.setattr(drive_robustness, "AGENT", "constant-velocity")
    with pytest.raises(InputError, match="no camera FTCAM_TELE_F0"):
        drive_robustness.BENCHMARK.arms["lost_tele"](0)
