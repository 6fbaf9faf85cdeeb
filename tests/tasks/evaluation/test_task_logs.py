"""Maps and motion judged by 123D logs: the frames that results name, in the right frames of reference."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flat_street import street
from test_agent_futures import on_circle
from test_agent_futures import write as write_tracks
from test_map_elements import log_with

from foredrive.data.boxes import read_boxes
from foredrive.data.logs import Log
from foredrive.data.truth.agent_futures import read_futures
from foredrive.data.truth.map_elements import read_map_elements
from foredrive.errors import InputError
from foredrive.scene.map_elements import ElementKind
from foredrive.tasks.maps.files import read_maps
from foredrive.tasks.maps.score import score_map_files
from foredrive.tasks.motion.files import STEPS, read_agents
from foredrive.tasks.motion.score import score_agent_files

NAMES = {
    ElementKind.DIVIDER: "divider",
    ElementKind.CROSSING: "ped_crossing",
    ElementKind.BOUNDARY: "boundary",
}


def name_of(log: Log, frame: int) -> str:
    return f"{log.path.name}@{log.t_us[frame]}"


def root_of(log: Log) -> Path:
    return log.path.folder.parents[2]


def write(path: Path, content: Any) -> Path:
    path.write_text(json.dumps(content))
    return path


def test_a_map_by_its_log(tmp_path: Path) -> None:
    """The log's own elements are perfect; moved by 1.2 m they are found at 1.5 m alone."""
    log = log_with(street(), tmp_path / "log", yaw=0.4)
    elements = read_map_elements(log, 10, (60.0, 30.0))
    vectors = [
        {
            "cls_name": NAMES[ElementKind(int(kind))],
            "pts": elements.vertices[n][elements.valid[n]].tolist(),
            "confidence_level": 0.8,
        }
        for n, kind in enumerate(elements.kind)
        if ElementKind(int(kind)) in NAMES
    ]
    results = tmp_path / "results.json"
    write(results, {"results": [{"sample_token": name_of(log, 10), "vectors": vectors}]})
    figures = score_map_files(read_maps(results, root_of(log)))
    assert figures["map.maptr.map"] == pytest.approx(1.0)
    assert (figures["map.frames_counted"], figures["area"]) == (1, "60x30")
    divider = vectors[0] | {"pts": [[x, y + 1.2] for x, y in vectors[0]["pts"]]}
    write(results, {"results": [{"sample_token": name_of(log, 10), "vectors": [divider]}]})
    figures = score_map_files(read_maps(results, root_of(log)))
    assert figures["map.maptr.ap_divider"] == pytest.approx(1 / 3)
    assert figures["map.maptr.ap_boundary"] == 0.0


def test_motion_by_a_log(tmp_path: Path) -> None:
    """Cars on circles, from an ego vehicle on a third: where they go, in the world frame, is perfect."""
    cars = {5: on_circle(20.0, 0.2, 2.8), 6: on_circle(24.0, 0.1, 0.4)}
    log = write_tracks(
        tmp_path / "log", lambda t: {n: car(t) for n, car in cars.items()}, on_circle(22.0, -0.15, 0.4)
    )
    boxes, futures = read_boxes(log, 3), read_futures(log, 3, STEPS, 0.5)
    assert boxes is not None
    T_world_ego = log.T_world_ego[3]

    def in_world(xy: np.ndarray, z: np.ndarray) -> np.ndarray:
        return np.concatenate([xy, z], axis=-1) @ T_world_ego[:3, :3].T + T_world_ego[:3, 3]

    centre = boxes.centre.double().numpy()
    path = in_world(
        futures.xy.double().numpy(), np.broadcast_to(centre[:, None, 2:], (len(centre), STEPS, 1))
    )
    records = [
        {
            "translation": in_world(centre[n, :2], centre[n, 2:]).tolist(),
            "detection_name": "car",
            "detection_score": 0.9,
            "trajs": [path[n, :, :2].tolist()],
        }
        for n in range(len(centre))
    ]
    results = write(tmp_path / "results.json", {name_of(log, 3): records})
    read = read_agents(results, root_of(log))
    np.testing.assert_allclose(read.true.xy, centre[:, :2], atol=1e-3)
    np.testing.assert_allclose(read.true.future_xy, futures.xy.numpy(), atol=1e-3)
    figures = score_agent_files(read)
    assert figures["motion.uniad.car.agents"] == 2
    assert figures["motion.uniad.car.epa"] == pytest.approx(1.0)
    assert figures["motion.uniad.car.min_fde_m"] == pytest.approx(0.0, abs=1e-3)


def test_frames_that_logs_do_not_have_are_named(tmp_path: Path) -> None:
    log = log_with([], tmp_path / "log")
    elsewhere = write(tmp_path / "results.json", {"flat_train/log@1": []})
    with pytest.raises(InputError, match=r"none of its 1 frames is in .* \(first: flat_train/log@1\)"):
        read_agents(elsewhere, root_of(log))
    empty = {"vectors": [], "labels": [], "scores": []}
    elsewhere = write(tmp_path / "results.json", {"results": {"flat_train/log@1": empty}})
    with pytest.raises(InputError, match=r"none of its 1 frames is in .* \(first: flat_train/log@1\)"):
        read_maps(elsewhere, root_of(log))


def test_a_log_without_a_map_judges_none(tmp_path: Path) -> None:
    log = write_tracks(tmp_path / "log", lambda t: {}, lambda t: (0.0, 0.0, 0.0))
    empty = {"vectors": [], "labels": [], "scores": []}
    results = write(tmp_path / "results.json", {"results": {name_of(log, 3): empty}})
    with pytest.raises(InputError, match="has no map to judge frame"):
        read_maps(results, root_of(log))
