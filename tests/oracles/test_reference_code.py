"""Our metrics beside figures that published evaluation code gave (`reference_code.py`)."""

from collections.abc import Mapping
from functools import reduce
from operator import add

import numpy as np
import pytest
from oracles.reference_code import FOLDER, METRICS
from oracles.reference_scenes import line_set

from foredrive.tasks.maps.map_raster_metric import count_raster, raster_figures
from foredrive.tasks.maps.precision import mean_precision, score_maps
from foredrive.tasks.maps.protocols import PROTOCOLS as MAPS
from foredrive.tasks.motion.agents import PredictedAgents, TrueAgents
from foredrive.tasks.motion.protocols import PROTOCOLS as MOTION
from foredrive.tasks.motion.scores import score_motion
from foredrive.tasks.occupancy.instances_metric import count_instances
from foredrive.tasks.occupancy.protocols import OCC3D_CLASSES, RAY_PROTOCOLS, UNIAD_INSTANCES
from foredrive.tasks.occupancy.score import cast_rays, count_rays, mean_iou, score_rays

Arrays = Mapping[str, np.ndarray]


def cases(metric: str) -> list[Arrays]:
    """Inputs and reference figures of each seed."""
    *_, seeds = METRICS[metric]
    return [dict(np.load(FOLDER / f"{metric}_{seed}.npz")) for seed in seeds]


def side_of(arrays: Arrays, side: str) -> dict[str, np.ndarray]:
    fields = {
        key.removeprefix(f"{side}."): value for key, value in arrays.items() if key.startswith(f"{side}.")
    }
    return {key: value.astype(np.float64) if key.endswith("xy") else value for key, value in fields.items()}


@pytest.mark.parametrize("arrays", cases("uniad_motion"))
def test_motion_and_epa_are_uniads(arrays: Arrays) -> None:
    """UniAD adds 1e-5 to the number of agents that EPA is divided by."""
    futures = arrays["predicted.future_xy"]
    predicted = PredictedAgents(**side_of(arrays, "predicted"), probability=np.ones(futures.shape[:2]))
    scores = score_motion(predicted, TrueAgents(**side_of(arrays, "true")), MOTION["uniad"])
    for name in ("car", "pedestrian"):
        reference = {key: arrays[f"reference.{name}.{key}"].item() for key in ("epa", "agents")}
        assert scores[name].agents == reference["agents"]
        assert scores[name].epa * scores[name].agents == pytest.approx(
            reference["epa"] * (reference["agents"] + 1e-5), abs=1e-9
        )
        for key, value in (
            ("min_ade_err", scores[name].min_ade_m),
            ("min_fde_err", scores[name].min_fde_m),
            ("miss_rate_err", scores[name].miss_rate),
        ):
            assert value == pytest.approx(arrays[f"reference.{name}.{key}"].item(), abs=1e-6), (name, key)


@pytest.mark.parametrize("arrays", cases("uniad_instances"))
def test_instances_over_time_are_uniads(arrays: Arrays) -> None:
    pairs = zip(arrays["predicted"].astype(np.int64), arrays["true"].astype(np.int64), strict=True)
    counts = [count_instances(predicted, true, UNIAD_INSTANCES) for predicted, true in pairs]
    for name in ("near", "far"):
        total = reduce(add, (by_range[name] for by_range in counts))
        assert total.iou == pytest.approx(arrays[f"reference.iou_{name}"].item(), abs=1e-6)
        assert total.vpq == pytest.approx(arrays[f"reference.vpq_{name}"].item(), abs=1e-6)


@pytest.mark.parametrize("arrays", cases("uniad_raster"))
def test_map_masks_are_uniads(arrays: Arrays) -> None:
    figures = raster_figures(count_raster(arrays["predicted"], arrays["true"]))
    for name in ("drivable", "lanes", "divider", "crossing", "contour"):
        ours = figures[f"iou_{'boundary' if name == 'contour' else name}"]
        assert ours == pytest.approx(arrays[f"reference.{name}"].item(), abs=1e-6), name


@pytest.mark.parametrize("arrays", cases("maptr"))
def test_map_lines_are_maptrs(arrays: Arrays) -> None:
    """No true line is a crossing, so that the mean leaves a class out."""
    predicted, true = line_set(arrays, "predicted"), line_set(arrays, "true")
    scores = score_maps(predicted, true, MAPS["maptr"], "60x30")
    ap = np.array([score.ap_at for score in scores.values()])
    np.testing.assert_allclose(ap.T, arrays["reference.ap"], atol=1e-6)
    assert mean_precision(scores, MAPS["maptr"]) == pytest.approx(
        arrays["reference.mean_ap"].mean(), abs=1e-6
    )


@pytest.mark.parametrize("arrays", cases("sparseocc_rays"))
def test_rays_are_sparseoccs(arrays: Arrays) -> None:
    free, protocol = len(OCC3D_CLASSES) - 1, RAY_PROTOCOLS["occ3d"]
    counts = [
        count_rays(cast_rays(origins, predicted, free), cast_rays(origins, true, free), protocol)
        for predicted, true, origins in zip(
            arrays["predicted"], arrays["true"], arrays["origins_m"], strict=True
        )
    ]
    scores = score_rays(reduce(add, counts), protocol)
    assert scores.rayiou == pytest.approx(arrays["reference.rayiou"].item(), abs=1e-12)
    for limit, iou in zip((1, 2, 4), scores.iou, strict=True):
        assert mean_iou(iou) == pytest.approx(arrays[f"reference.rayiou_{limit}"].item(), abs=1e-12)
