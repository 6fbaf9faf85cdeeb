"""DriveWorld from recipe to film, in miniature: what NeMo's runs do, its runs do as well."""

import dataclasses
import signal
from pathlib import Path

import av
import pytest
import torch
from miniature import STEPS, miniature, miniature_driveworld, write_log
from safetensors.torch import load_file
from transformers import BertConfig, BertModel, BertTokenizerFast

from benchmarks.common.forecast import forecasting, judge_forecast
from foredrive.data import ClipDataset, LogPath, collate
from foredrive.engine.checkpoints import load_weights, save_weights
from foredrive.engine.config import save_recipe
from foredrive.engine.metrics_log import read_metrics
from foredrive.engine.summary import read_summary
from foredrive.errors import InputError
from foredrive.methods.blocks.lifting import LiftingConfig
from foredrive.methods.blocks.pooled_lifting import PooledLiftingConfig
from foredrive.methods.driveworld import DriveWorld
from foredrive.methods.driveworld.ablations import driveworld_ablations
from foredrive.methods.driveworld.objective import DriveWorldObjective
from foredrive.methods.driveworld.planes import VectorToPlaneConfig
from foredrive.methods.driveworld.task_prompt import PROMPTS, PromptConfig
from foredrive.methods.recipe import Recipe
from foredrive.runs import Run, evaluate_run, open_run, predict_examples, train_run
from foredrive.runs.build import build_agent
from foredrive.runs.drive.agent_inputs import AgentInputs, inputs_of
from foredrive.runs.evaluate.display import DisplayPredictor
from foredrive.runs.evaluate.imagination import imagine_run
from foredrive.runs.export import export_run
from foredrive.runs.recipes.world_models import load_recipe
from foredrive.runs.train.run import load_agent
from foredrive.scene import Example
from foredrive.view.imagination_video import write_imagination_video
from foredrive.view.run_report import report_on_run, write_run_report

FUTURES = 2


@pytest.fixture(scope="module")
def run(log: LogPath, tmp_path_factory: pytest.TempPathFactory) -> Run:
    return train_run(miniature_driveworld(), [log], tmp_path_factory.mktemp("runs") / "driveworld")


def losses(folder: Path, stage: str) -> list[dict[str, float | int]]:
    lines = read_metrics(folder / stage / "metrics.jsonl")
    return [
        {name: value for name, value in line.items() if name not in ("step_s", "cpu_s")} for line in lines
    ]


def test_both_stages_are_trained(run: Run) -> None:
    assert open_run(run.folder) == run
    own = {"step", "loss", "kl", "occ", "action", "velocity", "flow"}
    assert [set(line) for line in losses(run.folder, "pretrain")] == [own] * STEPS
    assert [set(line) for line in losses(run.folder, "finetune")] == [own | {"wpts"}] * STEPS
    first, second = (
        load_file(run.folder / stage / "model.safetensors") for stage in ("pretrain", "finetune")
    )
    changed = {name for name in second if not torch.equal(first[name], second[name])}
    assert {"planner.plan", "world_model.statics.net.0.weight"} <= changed


def test_an_interrupted_run_goes_on_exactly(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    forward, calls = DriveWorldObjective.forward, iter(range(1, 100))

    def interrupted(self: DriveWorldObjective, example: Example, generator: torch.Generator) -> dict:
        if next(calls) == STEPS + 1:
            signal.raise_signal(signal.SIGINT)
        return forward(self, example, generator)

    arguments = (run.recipe, run.logs, tmp_path / "run", run.cache_dir)
    with monkeypatch.context() as patches:
        patches.setattr(DriveWorldObjective, "forward", interrupted)
        with pytest.raises(KeyboardInterrupt):
            train_run(*arguments)
    train_run(*arguments)
    for stage in ("pretrain", "finetune"):
        assert losses(tmp_path / "run", stage) == losses(run.folder, stage)


@pytest.mark.slow
def test_it_is_judged_beside_copies_of_the_present_and_by_its_futures(
    run: Run, log: LogPath, tmp_path: Path
) -> None:
    result = evaluate_run(run, [log], tmp_path)
    summary = read_summary(tmp_path / "summary.json")
    assert summary["failed"] == 0
    for scope in ("", "above_ground."):
        for when in ("future_500ms", "future_1s"):
            iou = f"occupancy.{scope}iou_{when}"
            assert {f"{iou}.copy", f"{iou}.carried_copy", f"{iou}.best_of_5", f"{iou}.mean_of_5"} <= set(
                summary
            )
            assert 0 <= summary[f"occupancy.{scope}spread_{when}"] <= 1
    assert "occupancy.iou_now.copy" not in summary
    assert "flow.epe_moving_now_mps" in summary
    assert "image.psnr_db" not in summary
    report = report_on_run(run, [log], result.summary, predict_examples(run, [log], 1), result.failures)
    write_run_report(tmp_path / "report.html", report)
    assert "ego-compensated persistence" in (tmp_path / "report.html").read_text()


def test_what_a_log_was_trained_on_is_not_what_a_forecast_is_judged_by(
    run: Run, log: LogPath, tmp_path: Path
) -> None:
    learned = forecasting(run.recipe, (0.0, 2.5), 0.5)
    few = train_run(learned, [log], tmp_path / "few", run.cache_dir, start=run.folder)
    assert set(losses(few.folder, "finetune")[0]) >= {"occ", "kl"}
    assert "wpts" not in losses(few.folder, "finetune")[0]
    figures = judge_forecast(few, [log], (2.5, 10.0))
    # Of 5 s: now is 0.5 or 1 s, with a future up to 2 s, since 2.5 s is left out; then 2.5 to 4 s.
    assert len(ClipDataset([log], learned.clips, None)) == 2
    assert figures["items"] == 4
    assert {"occupancy.iou_future_1s", "occupancy.iou_future_1s.carried_copy"} <= set(figures)
    nearer = forecasting(run.recipe, (0.0, 2.5), 0.5, future_frames=1)
    assert len(ClipDataset([log], nearer.clips, None)) == 3


def test_futures_are_drawn_alike_each_time_and_filmed(run: Run, log: LogPath, tmp_path: Path) -> None:
    arguments = {"seconds": 1.5, "samples": FUTURES, "moments": 2}
    moments = list(imagine_run(run, log, **arguments))
    again = list(imagine_run(run, log, **arguments))
    shape_zyx = run.recipe.clips.voxels.shape_zyx
    assert [moment.futures.shape for moment in moments] == [(FUTURES, 4, *shape_zyx)] * 2  # beyond L = 2
    assert all(torch.equal(a.futures, b.futures) for a, b in zip(moments, again, strict=True))
    assert all(torch.equal(moment.futures[0, 0], moment.futures[1, 0]) for moment in moments)  # now is seen
    assert moments[0].rendered is None
    assert moments[0].example.clip.image_valid.all()
    frames = write_imagination_video(tmp_path / "film.mp4", moments, 0.5)
    with av.open(str(tmp_path / "film.mp4")) as film:
        assert len(list(film.decode(video=0))) == frames == 2 * 5
    with pytest.raises(InputError, match="at least one moment"):
        next(imagine_run(run, log, seconds=0.1, samples=1, moments=1))


@pytest.mark.parametrize(("frames", "steps"), [(11, 1), (21, 3), (5, 0)])
def test_a_short_log_shortens_the_future_unless_a_length_is_asked_for(
    run: Run, tmp_path: Path, frames: int, steps: int
) -> None:
    """At 10 Hz, with 0.5 s before now: 1.0 s, 2.0 s and 0.4 s of a log."""
    short = write_log(tmp_path, frames=frames)
    if steps:
        (moment,) = imagine_run(run, short, samples=1, moments=1)
        assert moment.futures.shape[1] == 1 + steps
        assert moment.example.clip.image_valid.all()
    can = f"at most --seconds {0.5 * steps:g}" if steps else "too short for any future"
    with pytest.raises(InputError, match=f"model sees 0.5 s before now: {can}"):
        next(imagine_run(run, short, seconds=4.0, samples=1, moments=1))


def test_nemo_imagines_one_future_as_far_as_it_can_and_renders_it(
    trained: Run, log: LogPath, tmp_path: Path
) -> None:
    (moment,) = imagine_run(trained, log, seconds=1.0, samples=5, moments=1)
    assert moment.futures.shape[:2] == (1, 3)
    assert moment.rendered.shape == (3, 2, 3, 32, 64)
    assert write_imagination_video(tmp_path / "film.webp", [moment], 0.5) == 4
    (by_default,) = imagine_run(trained, log, samples=5, moments=1)
    assert torch.equal(by_default.futures, moment.futures)
    with pytest.raises(InputError, match="imagines at most 1 s"):
        next(imagine_run(trained, log, seconds=4.0, samples=5, moments=1))


def test_it_drives_and_is_looked_at(run: Run) -> None:
    assert inputs_of(str(run.folder)) == AgentInputs(cameras=True, lidar=False, past_frames=1)
    agent = load_agent(run)
    observed = collate([ClipDataset(run.logs, run.recipe.clips, run.cache_dir)[0]]).clip.observed()
    assert agent.act(observed).xy.shape == (1, 1, 6, 2)
    seen = DisplayPredictor(agent, 2).predict(observed)
    assert seen.flow_m.shape == (2, 3, *run.recipe.clips.voxels.shape_zyx)
    start, end = seen.movement_m(1, run.recipe.clips.voxels)
    assert start.shape == end.shape


@pytest.mark.parametrize("row", driveworld_ablations(miniature_driveworld()))
def test_every_row_trains(row: str, run: Run, example: Example) -> None:
    recipe = driveworld_ablations(miniature_driveworld())[row]
    torch.manual_seed(0)
    agent = build_agent(recipe)
    for stage in (recipe.pretrain, recipe.finetune):
        if stage is not None:
            objective = DriveWorldObjective(agent, stage, steps=2)
            objective(example, torch.Generator().manual_seed(0))["loss"].backward()
    assert agent.act(example.clip.observed()).xy.isfinite().all()


@pytest.fixture(scope="module")
def example(log: LogPath) -> Example:
    dataset = ClipDataset([log], miniature_driveworld().clips, None)
    return collate([dataset[0], dataset[3]])


def test_the_plane_may_come_from_deformable_lifting(example: Example) -> None:
    recipe = miniature_driveworld()
    lifting = PooledLiftingConfig(LiftingConfig(heads=2, points=2, layers=1))
    agent = build_agent(dataclasses.replace(recipe, model=dataclasses.replace(recipe.model, encoder=lifting)))
    objective = DriveWorldObjective(agent, recipe.pretrain, steps=2)
    objective(example, torch.Generator().manual_seed(0))["loss"].backward()
    assert agent.world_model.encoder.fold.weight.grad.abs().sum() > 0


def prompted(text_encoder: Path) -> Recipe:
    recipe = miniature_driveworld()
    prompt = PromptConfig(
        expand=VectorToPlaneConfig(widths=(8, 4)), encoding=16, text_encoder=str(text_encoder)
    )
    return dataclasses.replace(recipe, model=dataclasses.replace(recipe.model, prompt=prompt))


def test_a_trained_model_needs_no_text_encoder(tmp_path: Path, example: Example) -> None:
    folder, words = tmp_path / "bert", {word for text in PROMPTS.values() for word in text.lower().split()}
    folder.mkdir()
    (folder / "vocab.txt").write_text(
        "\n".join(["[PAD]", "[UNK]", "[CLS]", "[SEP]", ".", "##.", *sorted(words)])
    )
    BertTokenizerFast(str(folder / "vocab.txt")).save_pretrained(folder)
    small = {"hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2}
    BertModel(BertConfig(vocab_size=len(words) + 6, **small)).save_pretrained(folder)
    agent = build_agent(prompted(folder))
    world = agent.world_model
    assert isinstance(world, DriveWorld)
    objective = DriveWorldObjective(agent, prompted(folder).finetune, steps=2)
    before = world.prompt.encodings.clone()
    optimizer = torch.optim.AdamW(objective.parameters(), 0.1)
    objective(example, torch.Generator().manual_seed(0))["loss"].backward()
    optimizer.step()
    assert torch.equal(world.prompt.encodings, before)  # the text encoder is frozen
    assert world.prompt.expand.constant.grad.abs().sum() > 0
    save_weights(agent, tmp_path / "model.safetensors")
    elsewhere = build_agent(prompted(tmp_path / "not here"), fetch=False)
    load_weights(elsewhere, tmp_path / "model.safetensors")
    assert torch.equal(elsewhere.world_model.prompt.encodings, before)
    with pytest.raises(InputError, match="cannot be loaded"):
        build_agent(prompted(tmp_path / "not here"))


def test_whose_recipe_it_is_shows_in_what_is_written(tmp_path: Path) -> None:
    for recipe in (miniature(), miniature_driveworld()):
        save_recipe(recipe, tmp_path / "config.yaml")
        assert load_recipe(tmp_path / "config.yaml") == recipe
        text = (tmp_path / "config.yaml").read_text()
        (tmp_path / "config.yaml").write_text(text.replace("  width: 16", "  width: wide"))
        with pytest.raises(InputError, match=r"not a recipe: planner\.width: "):
            load_recipe(tmp_path / "config.yaml")


@pytest.mark.slow
def test_it_is_exported_as_it_runs_here(run: Run, log: LogPath, tmp_path: Path) -> None:
    facts = export_run(run, [log], tmp_path, clips=1)
    for program in ("model.pt2", "model.onnx"):
        assert facts["largest_difference"][program]["waypoints_xy"] < 1e-4
        assert facts["largest_difference"][program]["occupancy_logit"] < 1e-4
