"""Export a trained run to files for other runtimes, and compare them with the run on clips of logs."""

import dataclasses
import json
import time
import warnings
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.data import ClipDataset, LogPath, collate
from foredrive.engine.provenance import collect_provenance
from foredrive.errors import InputError
from foredrive.files import atomic_path, latest
from foredrive.integrations.graph import MEANING, AgentGraph, GraphInputs, GraphOutputs
from foredrive.methods.planner.agent import PlanningAgent
from foredrive.runs.open_clips import open_clips
from foredrive.runs.train.run import Run, load_agent
from foredrive.scene import Clip

PROGRAM, MODEL, REPORT = "model.pt2", "model.onnx", "export.json"
PACKAGES = ("onnx", "onnxscript", "onnxruntime")
ROUNDS = 3
"""Number of timed runs of each clip."""

Infer = Callable[[GraphInputs], GraphOutputs]


class _Sample(NamedTuple):
    """One observed clip (batch size 1), as a clip and as inputs of the graph."""

    observed: Clip
    inputs: GraphInputs


@torch.no_grad()
def export_run(run: Run, logs: Sequence[LogPath], out: Path, clips: int = 8) -> dict[str, Any]:
    """Write model.pt2 (torch.export), model.onnx (opset 20) and export.json.

    Both models take a batch of one and the cameras of `logs`. The function reads them back and compares their
    outputs and their latency with those of the PyTorch agent. The returned dict is the content of
    export.json.

    Args:
        run: a run that has finished a stage.
        logs: logs for the comparison.
        out: folder for the files.
        clips: number of clips, spread evenly over the logs.

    Raises:
        InputError: the packages of the extra `export` are missing, or there is nothing to export or to
            compare.
    """
    if clips < 1:
        raise InputError(f"the number of clips to compare must be at least 1, got {clips}")
    _check_packages()
    from foredrive.integrations.onnx import OPSET, write_onnx

    agent = load_agent(run)
    size = run.recipe.clips
    steps = size.future_frames
    dataset = open_clips(logs, size, run.cache_dir)
    samples = _samples(dataset, agent, min(clips, len(dataset)))
    graph = AgentGraph(agent, dataset.camera_names, size.image_hw, steps).eval()
    # Traced with one sample: batch size, cameras, image size and frames are fixed by its shapes
    program = torch.export.export(graph, tuple(samples[0].inputs))
    with atomic_path(out / PROGRAM) as temporary:
        torch.export.save(program, temporary)
    with atomic_path(out / MODEL) as temporary:
        write_onnx(program, temporary, GraphInputs._fields, GraphOutputs._fields)

    # The written files are read back, so that the comparison covers writing and loading too
    truth = [GraphOutputs.from_agent(agent(sample.observed, steps)) for sample in samples]
    runtimes = {PROGRAM: _program(latest(out / PROGRAM)), MODEL: _session(latest(out / MODEL))}
    outputs = {name: [infer(sample.inputs) for sample in samples] for name, infer in runtimes.items()}
    report = {
        "recipe": run.recipe.name,
        "run": str(run.folder),
        "opset": OPSET,
        "batch_size": "1, fixed",
        "cameras": list(dataset.camera_names),
        "frame_dt_s": size.frame_dt_s,
        "waypoint_dt_s": size.horizon_dt_s,
        "voxels": dataclasses.asdict(size.voxels),
        "inputs": _describe(samples[0].inputs),
        "outputs": _describe(truth[0]),
        "clips": len(samples),
        "largest_difference": {name: _max_difference(truth, result) for name, result in outputs.items()},
        "latency_ms": _latency_ms(agent, runtimes, samples, steps),
        "threads": torch.get_num_threads(),
        **collect_provenance(),
        **{f"version.{name}": metadata.version(name) for name in PACKAGES},
    }
    with atomic_path(out / REPORT) as temporary:
        temporary.write_text(json.dumps(report, indent=1))
    return report


def _samples(dataset: ClipDataset, agent: PlanningAgent[Any], count: int) -> list[_Sample]:
    """Return clips spread evenly over the logs."""
    every = len(dataset) / count if count else 0.0
    clips = [collate([dataset[int((k + 0.5) * every)]]).clip.observed() for k in range(count)]
    return [_Sample(observed, GraphInputs.from_clip(observed, agent)) for observed in clips]


def _check_packages() -> None:
    for name in PACKAGES:
        try:
            metadata.version(name)
        except metadata.PackageNotFoundError as error:
            raise InputError(f"package {name} is missing: pip install 'foredrive[export]'") from error


def _program(path: Path) -> Infer:
    """Read back a torch.export program."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # Raised by PyTorch itself
        module = torch.export.load(path).module()
    return lambda inputs: GraphOutputs(**module(*inputs))


def _session(path: Path) -> Infer:
    """Open an ONNX model in onnxruntime, on the CPU, with as many threads as PyTorch."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    options.log_severity_level = 3  # Errors only: warnings report every constant that is not folded
    session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    names = [entry.name for entry in session.get_inputs()]

    def infer(inputs: GraphInputs) -> GraphOutputs:
        # The model may lack inputs that its agent does not read, and the session refuses unknown ones
        fed = {name: tensor.numpy() for name, tensor in inputs._asdict().items() if name in names}
        return GraphOutputs(*(torch.from_numpy(array) for array in session.run(None, fed)))

    return infer


def _max_difference(truth: Sequence[GraphOutputs], outputs: Sequence[GraphOutputs]) -> dict[str, float]:
    """Return the maximum difference of each output over all clips, and the share of voxels that change state.

    Differences are in the unit of the output. A voxel changes state if its logit changes sign.
    """
    pairs = list(zip(truth, outputs, strict=True))
    differences = {
        name: max(float(_difference(name, getattr(a, name), getattr(b, name)).abs().max()) for a, b in pairs)
        for name in GraphOutputs._fields
    }
    flips = [((a.occupancy_logit > 0) != (b.occupancy_logit > 0)) for a, b in pairs]
    return differences | {"share_of_voxels_that_flip": float(torch.stack(flips).double().mean())}


def _difference(name: str, a: Tensor, b: Tensor) -> Float[Tensor, "..."]:
    """Return a - b; for angles, wrapped to [-pi, pi)."""
    return torch.remainder(a - b + torch.pi, 2 * torch.pi) - torch.pi if name == "waypoints_yaw" else a - b


def _latency_ms(
    agent: PlanningAgent[Any], runtimes: dict[str, Infer], samples: Sequence[_Sample], steps: int
) -> dict[str, dict[str, float]]:
    """Return median and 90th percentile of the latency of one clip, ms.

    The runtimes take turns, so that a busy machine slows all of them alike.
    """
    times: dict[str, list[float]] = {"eager": [], **{name: [] for name in runtimes}}
    for _ in range(ROUNDS):
        for sample in samples:
            start = time.perf_counter()
            agent(sample.observed, steps)
            times["eager"].append(time.perf_counter() - start)
            for name, infer in runtimes.items():
                start = time.perf_counter()
                infer(sample.inputs)
                times[name].append(time.perf_counter() - start)
    return {
        name: {"median": 1e3 * float(np.median(spent)), "p90": 1e3 * float(np.quantile(spent, 0.9))}
        for name, spent in times.items()
    }


def _describe(tensors: GraphInputs | GraphOutputs) -> dict[str, dict[str, object]]:
    return {
        name: {
            "shape": list(tensor.shape),
            "dtype": str(tensor.dtype).removeprefix("torch."),
            "meaning": MEANING[name],
        }
        for name, tensor in tensors._asdict().items()
    }
