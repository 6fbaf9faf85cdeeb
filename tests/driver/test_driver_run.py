"""Training a driver from logs: packed clips, a run that is continued, figures, and drives."""

import dataclasses
from pathlib import Path

import pytest
import torch

from benchmarks.common.shipping import ship_driver
from foredrive.data import ClipDataset
from foredrive.data.log_paths import LogPath
from foredrive.driver.agent import SightDriver
from foredrive.driver.judging import judge_sight
from foredrive.driver.packed import PackedClips, join
from foredrive.driver.recipes import DriverRecipe, driver_nemo, driver_small
from foredrive.engine.metrics_log import read_metrics
from foredrive.errors import InputError
from foredrive.runs import model_card, shipped
from foredrive.runs.drive.agent_inputs import inputs_of, rig_of
from foredrive.runs.drive.agents import make_agent
from foredrive.runs.drive.in_towns import TownRoutes
from foredrive.runs.model_card import find_card, read_card, shipped_weights
from foredrive.runs.recipes.known import find_recipe
from foredrive.runs.recipes.reconstruction import ReconstructionRecipe
from foredrive.runs.shipped import DRIVER, run_folder
from foredrive.runs.train.driver import load_driver, open_driver, train_driver
from foredrive.runs.train.run import load_agent, open_run
from foredrive.sensors.rigs import FRONT_TELE, camera_rig, same_rig
from foredrive.towns import virtual_egos
from foredrive.towns.driving.demonstrations import AlternatingStudent
from foredrive.towns.driving.town import TownSimulator
from foredrive.towns.sensing.capture import SensorSuite
from foredrive.towns.world import World


@pytest.fixture(scope="module")
def logs(world02: World, tmp_path_factory: pytest.TempPathFactory) -> list[LogPath]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(virtual_egos, "World", lambda town, seed, conditions: world02)
        sensors = SensorSuite(camera_rig(plan=FRONT_TELE.of_size((32, 64))), None)
        return virtual_egos.record_virtual_egos("Town02", 3, 4, tmp_path_factory.mktemp("egos"), sensors)


def recipe() -> DriverRecipe:
    small = driver_small()
    return dataclasses.replace(
        small,
        clips=dataclasses.replace(small.clips, image_hw=(32, 64)),
        see=dataclasses.replace(small.see, batch_size=4, epochs=None, steps=4, checkpoint_every=2),
        plan=dataclasses.replace(small.plan, steps=20, clips=10, speeds=2),
    )


@pytest.fixture(scope="module")
def dataset(logs: list[LogPath]) -> ClipDataset:
    return ClipDataset(logs, recipe().clips, None)


def test_packed_clips_are_those_of_the_logs(dataset: ClipDataset, tmp_path: Path) -> None:
    clips = PackedClips(dataset, tmp_path)
    with pytest.raises(InputError, match="a packed clip cannot be read"):
        clips[0]
    clips.pack()
    written = {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*.safetensors")}
    assert len(written) == clips.logs == 4
    batch = join([clips[0], clips[7]])
    for row, index in enumerate((0, 7)):
        clip, truth = dataset.clip(index), dataset.truth(index)
        assert torch.equal(batch.clip.images[row], clip.images)
        assert torch.equal(batch.clip.T_world_ego[row], clip.T_world_ego)
        assert torch.equal(batch.clip.route_xy[row], clip.route_xy)
        assert truth is not None
        assert truth.affordances is not None
        assert torch.equal(batch.truth.occupied[row], truth.affordances.occupied)
        assert int(batch.truth.light[row]) == int(truth.affordances.light)
        lamps = len(truth.affordances.lamp_xyz)
        assert torch.equal(batch.truth.lamp_xyz[row, :lamps], truth.affordances.lamp_xyz)
        assert batch.key[row] == dataset.key(index)
    damaged = next(iter(written))
    damaged.write_bytes(b"damaged")
    PackedClips(dataset, tmp_path).pack()
    again = {file: file.stat().st_mtime_ns for file in written}
    assert {file for file in written if again[file] != written[file]} == {damaged}


def test_another_part_of_a_log_has_files_of_its_own(logs: list[LogPath], tmp_path: Path) -> None:
    """Its clips are at other rows; the rows of the whole log are others' clips."""
    keys = []
    for part_s in (None, (1.0, 2.6)):
        dataset = ClipDataset(logs, dataclasses.replace(recipe().clips, part_s=part_s), None)
        clips = PackedClips(dataset, tmp_path)
        clips.pack()
        for index in range(len(clips)):
            assert torch.equal(clips[index].clip.T_world_ego, dataset.clip(index).T_world_ego)
        keys.append([clips[index].key for index in range(len(clips))])
    assert set(keys[1]) < set(keys[0])


def test_a_run_is_continued_and_drives(logs: list[LogPath], dataset: ClipDataset, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    run = train_driver(recipe(), logs, folder, tmp_path / "cache")
    assert [step["step"] for step in read_metrics(folder / "see/metrics.jsonl")] == [1, 2, 3, 4]
    driver = load_driver(open_driver(folder))
    (folder / "plan/model.safetensors").unlink()
    eyes = (folder / "see/model.safetensors").stat().st_mtime_ns
    train_driver(recipe(), logs, folder, tmp_path / "cache")
    assert (folder / "see/model.safetensors").stat().st_mtime_ns == eyes
    for name, weight in load_driver(run).state_dict().items():
        torch.testing.assert_close(weight, driver.state_dict()[name])
    with pytest.raises(InputError, match="another recipe"):
        train_driver(dataclasses.replace(recipe(), precision="32-true"), logs, folder, tmp_path / "cache")
    with pytest.raises(InputError, match="the run of a driver"):
        open_run(folder)

    figures = judge_sight(driver, PackedClips(dataset, tmp_path / "cache/packed"))
    assert figures["frames"] == len(dataset)
    assert 0 <= figures["conflict_false"] <= 1

    agent = make_agent(str(folder), lambda: 0.0)
    plan = agent.act(join([PackedClips(dataset, tmp_path / "cache/packed")[0]]).clip)
    assert plan.xy.shape == (1, 1, 6, 2)
    assert bool(plan.xy.isfinite().all())
    town = TownSimulator()
    assert isinstance(make_agent(f"student:{folder}", lambda: 0.0, town), AlternatingStudent)
    with pytest.raises(InputError, match="the run of a driver"):
        make_agent(f"ego-mlp:{folder}", lambda: 0.0)
    by_rule = make_agent(f"idm:{folder}", lambda: 0.0)
    plan = by_rule.act(join([PackedClips(dataset, tmp_path / "cache/packed")[0]]).clip)
    assert bool(plan.xy.isfinite().all())
    assert isinstance(make_agent(f"true-lights:{folder}", lambda: 0.0, town), SightDriver)
    with pytest.raises(InputError, match="true-lights:RUN"):
        make_agent(f"true-light:{folder}", lambda: 0.0, town)
    inputs = inputs_of(str(folder))
    assert (inputs.cameras, inputs.lidar, inputs.past_frames) == (True, False, 1)
    assert inputs.camera_names == ("pcam_f0", "ftcam_tele_f0")


@pytest.mark.slow
def test_a_driver_becomes_a_model_of_the_package(
    logs: list[LogPath], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = train_driver(recipe(), logs, tmp_path / "run", tmp_path / "cache")
    rig = FRONT_TELE.of_size((32, 64))
    route = TownRoutes("town05-short", rig=rig, only=("26",), vehicles=0, people=0, scenarios=False)
    models = tmp_path / "models"
    ship_driver(run, DRIVER, logs, route, tmp_path / "work", "Four logs.", "It has learned nothing.", models)
    for module in (shipped, model_card):
        monkeypatch.setattr(module, "MODELS", models)
    monkeypatch.chdir(tmp_path)
    assert same_rig(rig_of("embedded"), rig)
    small = load_driver(open_driver(run_folder(Path("embedded"))))
    for name, weight in load_driver(run).eyes.state_dict().items():
        torch.testing.assert_close(small.eyes.state_dict()[name], weight, atol=0.02, rtol=0.02)
    card = read_card(find_card(DRIVER))
    assert 0 <= card.figures["completion of routes, %"][0] <= 100
    assert "recall of conflicts ahead" in card.figures
    assert shipped_weights()[0].kind == "driver by sight"


def test_a_run_goes_on_from_another_drivers_weights(logs: list[LogPath], tmp_path: Path) -> None:
    """A driver that knows no stop signs may learn them, one that knows them must not forget them."""
    before = dataclasses.replace(recipe(), eyes=dataclasses.replace(recipe().eyes, signs=False))
    first = train_driver(before, logs, tmp_path / "first", tmp_path / "cache")
    see = dataclasses.replace(recipe().see, steps=0)
    for name, signs in (("second", False), ("third", True)):
        more = dataclasses.replace(before, see=see, eyes=dataclasses.replace(before.eyes, signs=signs))
        run = train_driver(more, logs, tmp_path / name, tmp_path / "cache", first.folder)
        own = load_driver(run).eyes.state_dict()
        assert any(".signs." in weight for weight in own) == signs
        for weight, value in load_driver(first).eyes.state_dict().items():
            torch.testing.assert_close(own[weight], value)
    none = dataclasses.replace(before, see=see)
    with pytest.raises(InputError, match="another architecture"):
        train_driver(none, logs, tmp_path / "fourth", tmp_path / "cache", tmp_path / "third")


def test_eyes_that_read_a_volume_start_from_a_pretrained_run(logs: list[LogPath], tmp_path: Path) -> None:
    nemo, start = driver_nemo(), run_folder(Path("embedded:nemo_town"), tmp_path)
    short = dataclasses.replace(recipe().see, steps=0)
    small = dataclasses.replace(recipe(), eyes=nemo.eyes, see=short)
    fresh = load_driver(train_driver(small, logs, tmp_path / "fresh", tmp_path / "cache"))
    started = load_driver(train_driver(small, logs, tmp_path / "started", tmp_path / "cache", start))
    weights = load_agent(open_run(start)).world_model.state_dict()
    for name, weight in started.eyes.state_dict().items():
        if not name.startswith("reader"):
            torch.testing.assert_close(weight, weights[name])
    pairs = zip(fresh.eyes.encoder.parameters(), started.eyes.encoder.parameters(), strict=True)
    assert any(not torch.equal(one, other) for one, other in pairs)
    cameras = dataclasses.replace(recipe(), see=short)
    with pytest.raises(InputError, match="only eyes that read a volume"):
        train_driver(cameras, logs, tmp_path / "x", tmp_path / "cache", start)


def test_recipes_of_drivers_are_found_by_name_and_file(tmp_path: Path) -> None:
    from foredrive.engine.config import save_recipe

    with pytest.raises(InputError, match="driver_small: this recipe is for `foredrive train`"):
        find_recipe("driver_small", (), ReconstructionRecipe)
    changed = find_recipe("driver_small", ["see.epochs=1"], DriverRecipe)
    assert changed.see.epochs == 1
    save_recipe(changed, tmp_path / "mine.yaml")
    assert find_recipe(str(tmp_path / "mine.yaml"), (), DriverRecipe) == changed
    with pytest.raises(InputError, match="driver_small"):
        find_recipe("driver_smal")
