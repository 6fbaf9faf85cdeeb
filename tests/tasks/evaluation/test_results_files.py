"""Files that an evaluation writes: scored, they give the figures that the evaluation printed."""

import dataclasses
import json
from pathlib import Path

import pytest
import torch
from recorded_street import near_truth, read_batch, record

from foredrive.data.clip_config import TaskTruthConfig
from foredrive.files import together
from foredrive.scene import Example, VoxelSpec
from foredrive.tasks.detection.detection_metric import DetectionMetric
from foredrive.tasks.detection.figures import score_objects
from foredrive.tasks.evaluation.results_files import ResultsFiles
from foredrive.tasks.maps.files import read_maps
from foredrive.tasks.maps.map_lines_metric import MapLinesMetric
from foredrive.tasks.maps.score import score_map_files
from foredrive.tasks.metric import EvaluationContext, Figures
from foredrive.tasks.motion.files import read_agents
from foredrive.tasks.motion.motion_metric import MotionMetric
from foredrive.tasks.motion.score import score_agent_files
from foredrive.tasks.objects.reading import read_objects
from foredrive.tasks.occupancy.log_results import score_against_logs
from foredrive.tasks.occupancy.semantics_metric import SemanticVoxelMetric
from foredrive.tasks.predictor import Prediction
from foredrive.tasks.tracking.score import score_tracks
from foredrive.tasks.tracking.tracking_metric import TrackingMetric


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("street"))


@pytest.fixture(scope="module")
def example(logs: Path) -> Example:
    return read_batch(logs)


def write(folder: Path, prediction: Prediction, example: Example) -> None:
    """Add the batch in two parts, as an evaluation does."""
    with ResultsFiles.written_to(folder) as files:
        for part in (slice(0, 2), slice(2, None)):
            files.add(prediction[part], dataclasses.replace(example[part], key=example.key[part]))


def evaluated(metric: type, prediction: Prediction, example: Example) -> Figures:
    started = metric(EvaluationContext(0.5))
    started.update(prediction, example)
    return {f"{started.name}.{key}": value for key, value in started.result().items()}


def assert_same_figures(printed: Figures, scored: Figures, at_least: int) -> None:
    both = [key for key in printed if key in scored and "." in key and "frames" not in key]
    assert len(both) >= at_least, both
    for key in both:
        assert scored[key] == pytest.approx(printed[key], rel=1e-6, abs=1e-6, nan_ok=True), key


def test_detections(logs: Path, example: Example, tmp_path: Path) -> None:
    prediction = near_truth(example)
    write(tmp_path, prediction, example)
    printed = evaluated(DetectionMetric, prediction, example)
    assert 0.05 < float(printed["detection.nuscenes.map"]) < 0.3  # three of ten classes, with noise
    scored = score_objects(*read_objects(tmp_path / "detection.json", logs, "detection"))
    assert_same_figures(printed, scored, 30)
    assert scored["frames_counted"] == len(example.key)


def test_motion(logs: Path, example: Example, tmp_path: Path) -> None:
    prediction = near_truth(example)
    write(tmp_path, prediction, example)
    printed = evaluated(MotionMetric, prediction, example)
    assert 0.3 < float(printed["motion.sparsedrive.car.min_ade_m"]) < 5
    assert_same_figures(printed, score_agent_files(read_agents(tmp_path / "motion.json", logs)), 30)


def test_map_lines(logs: Path, example: Example, tmp_path: Path) -> None:
    prediction = near_truth(example)
    write(tmp_path, prediction, example)
    printed = evaluated(MapLinesMetric, prediction, example)
    assert 0.05 < float(printed["map.maptr.map"]) < 1
    assert_same_figures(printed, score_map_files(read_maps(tmp_path / "map.json", logs)), 12)


def test_lines_beyond_the_area_do_not_change_it(logs: Path, example: Example, tmp_path: Path) -> None:
    """Predicted points 40 m ahead would be taken for those of the larger area, if the file did not tell."""
    prediction = near_truth(example)
    assert prediction.map_lines is not None
    far = dataclasses.replace(prediction.map_lines, points=1.4 * prediction.map_lines.points)
    prediction = dataclasses.replace(prediction, map_lines=far)
    write(tmp_path, prediction, example)
    assert float(far.points.abs().max()) > 31
    printed = evaluated(MapLinesMetric, prediction, example)
    assert_same_figures(printed, score_map_files(read_maps(tmp_path / "map.json", logs)), 12)


def test_tracks(logs: Path, example: Example, tmp_path: Path) -> None:
    prediction = near_truth(example)
    write(tmp_path, prediction, example)
    printed = evaluated(TrackingMetric, prediction, example)
    assert float(printed["tracking.nuscenes.ids"]) > 0
    scored = score_tracks(*read_objects(tmp_path / "tracking.json", logs, "tracking"))
    assert_same_figures(printed, scored, 40)


def test_the_truth_as_tracks_is_perfect(logs: Path, example: Example, tmp_path: Path) -> None:
    """Three of seven classes are there, with the identities of the log."""
    prediction = near_truth(example)
    boxes, agents = example.clip.boxes[:, example.clip.now], prediction.agents
    assert agents is not None
    names = ("centre", "size_lwh", "yaw", "velocity", "category", "attribute", "track_id")
    perfect = {name: getattr(boxes, name) for name in names}
    first = agents.map_tensors(lambda tensor: tensor[:, :4])
    write(tmp_path, Prediction(agents=dataclasses.replace(first, **perfect)), example)
    scored = score_tracks(*read_objects(tmp_path / "tracking.json", logs, "tracking"))
    for name in ("car", "truck", "pedestrian"):
        assert scored[f"tracking.nuscenes.{name}.amota"] == pytest.approx(1.0)
        assert scored[f"tracking.nuscenes.{name}.ids"] == 0


@pytest.mark.parametrize("flow", [False, True])
def test_voxels(logs: Path, tmp_path: Path, flow: bool) -> None:
    """On a grid of 1 m, with the rays, velocities and masks of the log; also with one camera alone."""
    spec = VoxelSpec((-6.0, -8.0, -1.0), 1.0, (3, 16, 12))
    cameras = ("ahead",) if flow else None
    example = read_batch(logs, TaskTruthConfig(rays=True), spec, cameras)
    prediction = near_truth(example)
    if flow:
        rng = torch.Generator().manual_seed(1)
        speed = torch.randn(len(example.key), 1, 3, *spec.shape_zyx, generator=rng)
        prediction = dataclasses.replace(prediction, flow_mps=speed)
    write(tmp_path, prediction, example)
    printed = evaluated(SemanticVoxelMetric, prediction, example)
    assert 20 < float(printed["occupancy.occ3d.miou_pct"]) < 90
    assert 20 < float(printed["occupancy.occ3d.rayiou_1m_pct"]) < 90
    assert 0.1 < float(printed["occupancy.openocc.occ_score"]) < 0.9
    scored = score_against_logs(tmp_path / "occupancy", logs)
    assert_same_figures(printed, scored, 60)
    assert scored["frames_without_velocity"] == (0 if flow else len(example.key))


def test_agents_without_identity_are_no_tracks(example: Example, tmp_path: Path) -> None:
    prediction = near_truth(example)
    assert prediction.agents is not None
    none = dataclasses.replace(prediction.agents, track_id=prediction.agents.track_id * 0 - 1)
    write(tmp_path, dataclasses.replace(prediction, agents=none), example)
    assert {path.name for path in tmp_path.iterdir()} >= {"detection.json", "motion.json", "map.json"}
    assert not (tmp_path / "tracking.json").exists()


def test_frames_without_annotation_are_left_out_unless_all_are(example: Example, tmp_path: Path) -> None:
    clip = example.clip
    some = clip.boxes_valid.clone()
    some[1:] = False
    for valid, expected in ((some, 1), (torch.zeros_like(some), len(example.key))):
        truth = dataclasses.replace(example, clip=dataclasses.replace(clip, boxes_valid=valid))
        write(tmp_path, near_truth(example), truth)
        assert len(json.loads((tmp_path / "detection.json").read_text())["results"]) == expected


def test_a_frame_without_tracks_still_counts(logs: Path, example: Example, tmp_path: Path) -> None:
    """Its road users are missed. Left out of the file, it would not be scored."""
    prediction = near_truth(example)
    assert prediction.agents is not None
    track_id = prediction.agents.track_id.clone()
    track_id[1] = -1
    hidden = dataclasses.replace(prediction.agents, track_id=track_id)
    prediction = dataclasses.replace(prediction, agents=hidden)
    write(tmp_path, prediction, example)
    results = json.loads((tmp_path / "tracking.json").read_text())["results"]
    assert list(results) == list(example.key)
    assert results[example.key[1]] == []
    printed = evaluated(TrackingMetric, prediction, example)
    scored = score_tracks(*read_objects(tmp_path / "tracking.json", logs, "tracking"))
    assert_same_figures(printed, scored, 40)


def test_files_of_an_earlier_evaluation_are_removed(example: Example, tmp_path: Path) -> None:
    """Of more frames, and with identities; what others have put there stays."""
    prediction = near_truth(example)
    write(tmp_path, prediction, example)
    (tmp_path / "notes.json").write_text("{}")
    assert prediction.agents is not None
    none = dataclasses.replace(prediction.agents, track_id=prediction.agents.track_id * 0 - 1)
    few = dataclasses.replace(prediction, agents=none)[:2]
    with together(tmp_path.parent), ResultsFiles.written_to(tmp_path) as files:
        files.add(few, dataclasses.replace(example[:2], key=example.key[:2]))
        assert (tmp_path / "tracking.json").exists()
    found = {path.relative_to(tmp_path / "occupancy").as_posix() for path in tmp_path.rglob("*.npz")}
    assert found == {f"{key}.npz" for key in example.key[:2]}
    assert not (tmp_path / "tracking.json").exists()
    assert (tmp_path / "notes.json").exists()


def test_files_of_an_interrupted_evaluation_do_not_appear(example: Example, tmp_path: Path) -> None:
    """Neither beside those of an earlier evaluation nor in their place, and without a trace."""
    prediction, folder = near_truth(example), tmp_path / "results"
    write(folder, prediction[:2], dataclasses.replace(example[:2], key=example.key[:2]))
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}

    def interrupted() -> None:
        with ResultsFiles.written_to(folder) as files:
            files.add(prediction, example)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
