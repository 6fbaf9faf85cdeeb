"""Vector maps scored under every protocol."""

import numpy as np

from foredrive.evaluation.maps.files import MapFiles
from foredrive.evaluation.summary import Figures
from foredrive.metrics.detection import mean_of_valid
from foredrive.metrics.maps.lines import CLASSES
from foredrive.metrics.maps.precision import MapPrecision, mean_precision, score_maps
from foredrive.metrics.maps.protocols import HALF_XY_M, PROTOCOLS, Area
from foredrive.scene.map_elements import ElementKind

FIGURES = {
    "maptr": ("maptr", ""),
    "streammapnet": ("streammapnet", ""),
    "sparsedrive": ("sparsedrive", ""),
    "maptracker_consistent": ("maptracker", "c_"),
    "maptracker_consistent_corrected": ("maptracker", "corrected_c_"),
}
"""Group of figures and prefix of their keys, by protocol. MapTracker's mAP is StreamMapNet's."""


def score_map_files(files: MapFiles) -> Figures:
    """Return `map.maptr.map`, `map.maptr.ap_divider`, … The area is the smaller one that holds the truth.

    C-mAP has figures only if both files state identities.
    """
    area = area_of(files)
    classes = [*CLASSES]
    if (files.true.kind == ElementKind.CENTRELINE).any():
        classes.append(ElementKind.CENTRELINE)
    figures: Figures = {"area": area, "map.frames_counted": len(files.tokens)}
    figures |= {"frames_without_results": files.frames_without_results, "vectors_too_short": files.short}
    tracked = files.predicted.identity is not None and files.true.identity is not None
    for name, protocol in PROTOCOLS.items():
        if protocol.identity and not tracked:
            continue
        scores = score_maps(files.predicted, files.true, protocol, area, drive=files.drive, classes=classes)
        group, prefix = FIGURES[name]
        figures[f"map.{group}.{prefix}map"] = mean_precision(scores, protocol)
        if protocol.absent_classes == "left_out":
            figures[f"map.{group}.map_all_classes"] = mean_of_valid([score.ap for score in scores.values()])
        figures |= {f"map.{group}.{prefix}{key}": value for key, value in _of_classes(scores).items()}
    for kind in classes:
        figures[f"map.true_{kind.name.lower()}"] = int((files.true.kind == kind).sum())
    return figures


def area_of(files: MapFiles) -> Area:
    """Return the area whose sides the true elements keep to: 60 × 30 m, or else 100 × 50 m."""
    reach_m = max((float(np.abs(line).max()) for line in files.true.lines), default=0.0)
    return "60x30" if reach_m <= max(HALF_XY_M["60x30"]) + 1.0 else "100x50"


def _of_classes(scores: dict[ElementKind, MapPrecision]) -> Figures:
    return {f"ap_{kind.name.lower()}": score.ap for kind, score in scores.items()}
