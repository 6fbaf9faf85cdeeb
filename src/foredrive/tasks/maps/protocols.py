"""The protocols of online mapping in use on nuScenes and Argoverse 2, as data.

Vector protocols average the area under the curve of precision over recall at three chamfer distances. A
prediction is compared with its nearest true element of the class alone: if that is farther than the distance,
or taken by a better scored prediction, it is false.

Facts read in the public code:
- MapTR: hustvl/MapTR, datasets/map_utils/{mean_ap,tpfp,tpfp_chamfer}.py, datasets/nuscenes_map_dataset.py;
  VAD has a copy of it. Its table of each distance leaves out classes without truth. The figure it reports at
  the end counts them as 0: `map_all_classes` here
- StreamMapNet: yuantianyuan01/StreamMapNet, datasets/evaluation/{vector_eval,AP}.py; MapTracker's mAP is the
  same
- SparseDrive: swc-17/SparseDrive, datasets/evaluation/map/vector_eval.py: the same without the larger area
- C-mAP: woodfrog/maptracker, tools/tracking/calculate_cmap.py and cmap_utils/data_utils.py. True elements
  pass through 20 points. A true element belongs to the identity that finds it first in a drive; predictions
  of other identities on it are false. As released, all predictions of a class are dropped in frames without
  truth of this class ("maptracker_consistent"), which its own mAP counts as false; with them counted it is
  "maptracker_consistent_corrected"
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

Area = Literal["60x30", "100x50"]
"""Area around the ego vehicle: metres along x and y."""
HALF_XY_M: Mapping[Area, tuple[float, float]] = {"60x30": (30.0, 15.0), "100x50": (50.0, 25.0)}
NEAR_M = (0.5, 1.0, 1.5)
FAR_M = (1.0, 1.5, 2.0)


@dataclass(frozen=True)
class VectorProtocol:
    """The choices that define an average precision of polylines."""

    title: str
    points: int
    """Number of points at which lines are compared."""
    distances_m: Mapping[Area, tuple[float, float, float]]
    """Chamfer distances of a match."""
    buffer_m: float | None = None
    """Pairs also need this: the lines, widened by this much to either side and cut off at the ends, meet."""
    absent_classes: Literal["left_out", "zero"] = "zero"
    """How classes without truth enter the mean."""
    identity: bool = False
    """True if a true element may be found by one identity alone."""
    true_points_first: int | None = None
    """Number of points through which true elements pass before they are compared."""
    frames_without_truth: Literal["false", "dropped"] = "false"
    """Whether predictions of a class are false in frames without truth of it, or dropped."""


PROTOCOLS: dict[str, VectorProtocol] = {
    "maptr": VectorProtocol(
        title="MapTR",
        points=100,
        distances_m={"60x30": NEAR_M, "100x50": NEAR_M},
        buffer_m=2.0,
        absent_classes="left_out",
    ),
    "streammapnet": VectorProtocol(
        title="StreamMapNet, MapTracker", points=200, distances_m={"60x30": NEAR_M, "100x50": FAR_M}
    ),
    "sparsedrive": VectorProtocol(
        title="SparseDrive", points=200, distances_m={"60x30": NEAR_M, "100x50": NEAR_M}
    ),
    "maptracker_consistent": VectorProtocol(
        title="MapTracker, C-mAP as released",
        points=200,
        distances_m={"60x30": NEAR_M, "100x50": FAR_M},
        identity=True,
        true_points_first=20,
        frames_without_truth="dropped",
    ),
    "maptracker_consistent_corrected": VectorProtocol(
        title="C-mAP with all false positives",
        points=200,
        distances_m={"60x30": NEAR_M, "100x50": FAR_M},
        identity=True,
        true_points_first=20,
    ),
}
