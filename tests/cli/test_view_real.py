"""From a raw key frame to a picture of it, on the command line."""

from pathlib import Path

import numpy as np
import pytest
from nuscenes_keyframe import written_keyframe
from PIL import Image

from foredrive.cli.main import main


@pytest.fixture(scope="module")
def key_frame(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    root, raw = tmp_path_factory.mktemp("logs"), written_keyframe(real_data, tmp_path_factory.mktemp("raw"))
    assert main(["convert", "nuscenes", str(raw), "--out", str(root)]) == 0
    return root


@pytest.mark.real
def test_a_log_is_converted_and_drawn(key_frame: Path, tmp_path: Path) -> None:
    picture = tmp_path / "sheet.png"
    assert main(["view", str(key_frame), "--save", str(picture), "--t", "0"]) == 0
    with Image.open(picture) as sheet:
        cells = np.asarray(sheet.convert("L"))[64:420, 10:1940]
    thirds = np.split(cells[:, : cells.shape[1] // 3 * 3], 3, axis=1)
    assert all(third.std() > 20 for third in thirds)  # three different camera images, none of them blank
    assert not np.array_equal(thirds[0], thirds[1])


@pytest.mark.real
def test_a_time_outside_the_log_is_refused(
    key_frame: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["view", str(key_frame), "--save", str(tmp_path / "x.png"), "--t", "7.5"]) == 2
    assert "no time 7.5 s in this log" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
