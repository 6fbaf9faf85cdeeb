"""Vector maps scored under every protocol."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy import ndarray

from foredrive.engine.summary import Figures
from foredrive.scene.map_elements import ElementKind
from foredrive.tasks.files.turned_axes import MAX_FRAMES, TURNS, tell_if_turned
from foredrive.tasks.maps.files import MapFiles
from foredrive.tasks.maps.lines import CLASSES
from foredrive.tasks.maps.precision import MapPrecision, mean_precision, score_maps
from foredrive.tasks.maps.protocols import PROTOCOLS
from foredrive.tasks.objects.matching import mean_of_valid

FIGURES = {
    "maptr": ("maptr", ""),
    "streammapnet": ("streammapnet", ""),
    "sparsedrive": ("sparsedrive", ""),
    "maptracker_consistent": ("maptracker", "c_"),
    "maptracker_consistent_corrected": ("maptracker", "corrected_c_"),
}
"""Group of figures and prefix of their keys, by protocol. MapTracker's mAP is StreamMapNet's."""


def score_map_files(files: MapFiles) -> Figures:
    """Return `map.maptr.map`, `map.maptr.ap_divider`, …

    Centrelines count where the results have any, and C-mAP if both files state identities.
    """
    area = files.area
    # Centrelines are judged only if the results have them
    classes = [*CLASSES]
    if (files.predicted.kind == ElementKind.CENTRELINE).any():
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


def tell_if_map_is_turned(files: MapFiles, path: Path) -> None:
    """Say in one line if the predictions of the first frames score far better with other axes."""
    protocol = PROTOCOLS["maptr"]
    true, predicted = (
        lines[np.flatnonzero(lines.frame < MAX_FRAMES)] for lines in (files.true, files.predicted)
    )

    def precision(lines: Sequence[ndarray]) -> float:
        turned = dataclasses.replace(predicted, lines=lines)
        scores = score_maps(turned, true, protocol, files.area, drive=files.drive, classes=CLASSES)
        return mean_precision(scores, protocol)

    turned = {turn: precision([turn.of_points(line) for line in predicted.lines]) for turn in TURNS}
    tell_if_turned(path, "MapTR's mAP of the first frames", precision(predicted.lines), turned)


def _of_classes(scores: dict[ElementKind, MapPrecision]) -> Figures:
    return {f"ap_{kind.name.lower()}": score.ap for kind, score in scores.items()}
