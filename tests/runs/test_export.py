"""A run as ONNX and torch.export: what the files say, beside the agent they come from."""

import dataclasses
import json
import shutil
from pathlib import Path

import pytest
import torch
from torch import nn

from foredrive.cli.main import main
from foredrive.data import ClipDataset, LogPath, collate, find_logs
from foredrive.errors import InputError
from foredrive.geometry.se3 import matrix_from_yaw
from foredrive.integrations.graph import GraphInputs
from foredrive.runs import Run, export, open_run
from foredrive.runs.shipped import EMBEDDED, MODELS, run_folder, shipped_models
from foredrive.runs.train.driver import is_driver
from foredrive.runs.train.run import load_agent
from foredrive.scene import Command

onnxruntime = pytest.importorskip("onnxruntime", reason="the extra `export` is not installed")
from foredrive.integrations.onnx import write_onnx  # noqa: E402


@pytest.fixture(scope="module")
def measured(trained: Run, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The run with ego motion that continues measured poses: float64 inputs, for which onnxruntime has fewer
    operators.
    """
    folder = tmp_path_factory.mktemp("measured") / "run"
    shutil.copytree(trained.folder, folder)
    config = (folder / "config.yaml").read_text()
    assert "ego: predicted" in config
    (folder / "config.yaml").write_text(config.replace("ego: predicted", "ego: measured"))
    return open_run(folder)


@pytest.fixture(scope="module")
def exported(measured: Run, log: LogPath, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("export")
    export.export_run(measured, [log], folder, clips=2)
    return folder


def test_both_files_say_what_the_agent_says(exported: Path) -> None:
    facts = json.loads((exported / "export.json").read_text())
    assert facts["clips"] == 2
    assert set(facts["largest_difference"]) == set(facts["latency_ms"]) - {"eager"}
    for differences in facts["largest_difference"].values():
        assert differences.pop("share_of_voxels_that_flip") <= 1e-3
        assert all(difference < 1e-4 for difference in differences.values())


def test_export_json_describes_the_model(exported: Path) -> None:
    facts = json.loads((exported / "export.json").read_text())
    session = onnxruntime.InferenceSession(exported / "model.onnx")
    for entries, described in (
        (session.get_inputs(), facts["inputs"]),
        (session.get_outputs(), facts["outputs"]),
    ):
        assert {entry.name: entry.shape for entry in entries} == {
            name: about["shape"] for name, about in described.items()
        }
        assert all(about["meaning"] for about in described.values())
    assert facts["outputs"]["occupancy_logit"]["shape"] == [1, 3, 2, 16, 16]  # now and two imagined frames
    assert facts["outputs"]["waypoints_xy"]["shape"] == [1, 6, 2]


def test_nothing_of_the_clip_it_was_traced_with_is_constant(
    exported: Path, measured: Run, log: LogPath
) -> None:
    clip = collate([ClipDataset([log], measured.recipe.clips, None)[1]]).clip.observed()
    lens = torch.tensor([-0.2, 0.03, 0.001, 0.002, 0.0])  # the log's cameras have none
    turned = matrix_from_yaw(torch.tensor([0.2]), torch.tensor([[-3.0, 0.5, 0.1]])).double()
    other = dataclasses.replace(
        clip,
        T_world_ego=torch.stack([clip.T_world_ego[:, -1] @ turned, clip.T_world_ego[:, -1]], dim=1),
        images=clip.images.flip(-1),
        image_valid=torch.tensor([[[True, False], [True, True]]]),
        rig=dataclasses.replace(
            clip.rig, K=clip.rig.K * torch.tensor([1.2, 1.2, 1.0])[:, None], dist=clip.rig.dist + lens
        ),
        ego_speed_mps=torch.tensor([[8.0, 9.0]]),
        command=torch.tensor([Command.LEFT]),
    )
    agent = load_agent(measured)
    session = onnxruntime.InferenceSession(exported / "model.onnx")
    inputs = GraphInputs.from_clip(other, agent)._asdict()
    said = session.run(None, {entry.name: inputs[entry.name].numpy() for entry in session.get_inputs()})
    with torch.no_grad():
        truth, before = agent(other, 2), agent(clip, 2)
    assert said[0] == pytest.approx(truth.plan.xy[:, 0].numpy(), abs=1e-4)
    for k, decoded in enumerate(truth.decoded):
        assert said[2][:, k] == pytest.approx(decoded.occupancy_logit.numpy(), abs=1e-4)
    for k, belief in enumerate(truth.beliefs[1:], start=1):
        assert belief.T_now_ego is not None
        assert said[3][:, k] == pytest.approx(belief.T_now_ego.numpy(), abs=1e-4)
    assert (truth.plan.xy - before.plan.xy).abs().max() > 1e-2  # so that a constant would show


@pytest.fixture(scope="module")
def town_log(tmp_path_factory: pytest.TempPathFactory) -> LogPath:
    """Eight seconds of a town, with all that the models that come along read."""
    folder = tmp_path_factory.mktemp("town")
    assert main(["record", "--town", "Town05", "--seconds", "8", "--seed", "3", "--out", str(folder)]) == 0
    (found,) = find_logs(folder / "logs" / "town_test")
    return found


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in shipped_models() if not is_driver(MODELS / name)])
def test_models_that_come_along_are_exported(name: str, town_log: LogPath, tmp_path: Path) -> None:
    run = open_run(run_folder(Path(EMBEDDED + name), tmp_path))
    facts = export.export_run(run, [town_log], tmp_path / "out", clips=1)
    for differences in facts["largest_difference"].values():
        assert differences.pop("share_of_voxels_that_flip") <= 1e-3
        assert all(difference < 1e-3 for difference in differences.values()), differences


@pytest.mark.parametrize(("shape", "size"), [((1, 2, 2, 7, 9), (1, 4, 4)), ((1, 1, 5, 3, 3), (2, 2, 3))])
def test_pooling_to_a_size_that_does_not_divide(
    shape: tuple[int, ...], size: tuple[int, int, int], tmp_path: Path
) -> None:
    assert_translated(nn.AdaptiveAvgPool3d(size), (torch.rand(shape),), tmp_path)


def test_the_greatest_so_far_and_where_it_was(tmp_path: Path) -> None:
    class Greatest(nn.Module):
        def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            found = x.cummax(dim=1)
            return found.values, found.indices

    assert_translated(Greatest(), (torch.tensor([[3, 1, 3, 4, 2], [0, 0, -1, 0, 5]]),), tmp_path)


def test_a_volume_read_beyond_its_border(tmp_path: Path) -> None:
    class Read(nn.Module):
        def forward(self, volume: torch.Tensor, grid: torch.Tensor) -> torch.Tensor:
            return nn.functional.grid_sample(volume, grid, align_corners=False)

    grid = 3 * torch.rand(1, 1, 2, 50, 3, generator=torch.Generator().manual_seed(0)) - 1.5
    assert_translated(Read(), (torch.rand(1, 2, 3, 4, 5), grid), tmp_path)


def test_attention_of_a_row_without_keys_is_zero(tmp_path: Path) -> None:
    class Attend(nn.Module):
        def forward(self, q: torch.Tensor, kv: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
            return nn.functional.scaled_dot_product_attention(q, kv, kv, attn_mask=mask)

    rng = torch.Generator().manual_seed(0)
    q, kv = torch.randn(2, 2, 3, 4, generator=rng), torch.randn(2, 2, 5, 4, generator=rng)
    mask = torch.zeros(2, 1, 3, 5)
    mask[0, 0, 1], mask[1, 0, 0, 2:] = -torch.inf, -torch.inf
    assert float(Attend()(q, kv, mask)[0, :, 1].abs().max()) == 0.0
    assert_translated(Attend(), (q, kv, mask), tmp_path)


def assert_translated(module: nn.Module, inputs: tuple[torch.Tensor, ...], folder: Path) -> None:
    """An operator that PyTorch's exporter does not know says in onnxruntime what it says in PyTorch."""
    expected = module(*inputs)
    expected = expected if isinstance(expected, tuple) else (expected,)
    names, path = [f"in{k}" for k in range(len(inputs))], folder / "part.onnx"
    write_onnx(torch.export.export(module, inputs), path, names, [f"out{k}" for k in range(len(expected))])
    session = onnxruntime.InferenceSession(path)
    said = session.run(None, {name: value.numpy() for name, value in zip(names, inputs, strict=True)})
    for got, wanted in zip(said, expected, strict=True):
        assert got == pytest.approx(wanted.numpy(), abs=1e-5)


def test_without_the_packages_it_is_one_line(
    trained: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(export, "PACKAGES", ("onnx", "no-such-package"))
    assert main(["export", str(trained.folder), "--out", str(tmp_path / "out")]) == 2
    assert "pip install 'foredrive[export]'" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_what_is_no_run_is_refused(trained: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(tmp_path)]) == 2
    assert "not a run folder" in capsys.readouterr().err
    with pytest.raises(InputError, match="must be at least 1"):
        export.export_run(trained, trained.logs, tmp_path, clips=0)
    assert list(tmp_path.iterdir()) == []
