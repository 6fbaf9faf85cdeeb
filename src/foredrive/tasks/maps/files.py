"""Vector maps in the JSON files of MapTR and of StreamMapNet's family (MapTracker, SparseDrive).

MapTR lists frames, under `results` or for the truth `GTs`: `sample_token` and `vectors`, each with `pts`,
`cls_name` and, if predicted, `confidence_level`.

StreamMapNet's files have frames by token, under `results` or alone: `vectors`, `labels` (0 crossing, 1
divider, 2 boundary) and, if predicted, `scores`. MapTracker's C-mAP also needs `global_ids`, and `scene_name`
and `local_idx` where there is more than one drive. MapTracker stores these, and its truth, in pickles.

Coordinates are metres in the frame of the vehicle or its lidar, the same in both files. The truth may also be
a folder of 123D logs: frames are named LOG@T_US then, and coordinates are in the ego frame. Results may state
their area under `meta` as `area_m`, [60, 30] or [100, 50].
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from foredrive.data.truth.map_elements import read_map_elements
from foredrive.errors import InputError
from foredrive.scene.map_elements import ElementKind
from foredrive.tasks.files.frames_of_results import check_known_frames, log_frames
from foredrive.tasks.files.plain_files import read_plain
from foredrive.tasks.maps.lines import LineSet
from foredrive.tasks.maps.protocols import HALF_XY_M, Area

_KINDS = {
    "divider": ElementKind.DIVIDER,
    "ped_crossing": ElementKind.CROSSING,
    "crossing": ElementKind.CROSSING,
    "boundary": ElementKind.BOUNDARY,
    "centerline": ElementKind.CENTRELINE,
}
_BY_LABEL = (ElementKind.CROSSING, ElementKind.DIVIDER, ElementKind.BOUNDARY)
"""Classes by the numbers of StreamMapNet, MapTracker and SparseDrive."""
MAX_M = 1e4
"""Limit of coordinates: a vector map is around the vehicle."""


@dataclass(frozen=True)
class MapFiles:
    """Predicted and true elements of the truth's frames."""

    predicted: LineSet
    true: LineSet
    tokens: Sequence[str]
    """Tokens of the frames; they are in order of time within a drive if there are identities."""
    drive: Int[ndarray, "F"]
    """Number of the drive of each frame."""
    area: Area
    """The smaller area that holds the truth. Where the truth is of logs: the area that the results state, or
    else the smaller one that holds the predictions."""
    frames_without_results: int
    short: int
    """Number of predictions with fewer than two points, which all protocols leave out."""


@dataclass(frozen=True)
class _Element:
    where: str
    kind: ElementKind
    points: Float[ndarray, "V 2"]
    score: float
    identity: int | None


@dataclass(frozen=True)
class _Frame:
    elements: Sequence[_Element]
    drive: str | None
    index: int | None


def read_maps(results: Path, truth: Path) -> MapFiles:
    """Read predicted and true vector maps; each file may be in either format, and the truth of logs.

    Raises:
        InputError: a file cannot be read, or an entry is wrong. The message names both.
    """
    predicted, stated = _read(results, predicted=True)
    if truth.is_dir():
        return _against_logs(predicted, results, truth, stated)
    true, _ = _read(truth, predicted=False)
    check_known_frames(results, predicted, truth, list(true))
    if not true:
        raise InputError(f"{truth}: holds no frames")
    tokens = _in_order(true)
    drives = {name: n for n, name in enumerate(dict.fromkeys(true[token].drive for token in tokens))}
    lines, short = _line_set([predicted.get(token) for token in tokens])
    true_lines, _ = _line_set([true[token] for token in tokens])
    return MapFiles(
        predicted=lines,
        true=true_lines,
        tokens=tokens,
        drive=np.array([drives[true[token].drive] for token in tokens]),
        area=area_of(true_lines),
        frames_without_results=len(set(true) - set(predicted)),
        short=short,
    )


def area_of(lines: LineSet) -> Area:
    """Return the area whose sides lines keep to: 60 × 30 m, or else 100 × 50 m."""
    reach_m = max((float(np.abs(line).max()) for line in lines.lines), default=0.0)
    # The tolerance of 1 m allows for points just outside
    return "60x30" if reach_m <= max(HALF_XY_M["60x30"]) + 1.0 else "100x50"


def _against_logs(predicted: dict[str, _Frame], results: Path, truth: Path, stated: Area | None) -> MapFiles:
    """Return predictions and the maps of logs at their frames, in the area that the results state, if any."""
    frames = list(log_frames(truth, predicted, results))
    lines, short = _line_set([predicted[frame.name] for frame in frames])
    area = stated or area_of(lines)
    # The truth is cut to the area in which the predictions are
    half_xy_m = HALF_XY_M[area]
    kinds, predicted_lines, number = [], [], []
    for n, frame in enumerate(frames):
        elements = read_map_elements(frame.log, frame.frame, (2 * half_xy_m[0], 2 * half_xy_m[1]))
        if not elements.known:
            raise InputError(f"{frame.log.path.folder} has no map to judge frame {frame.name} by")
        for vertices, valid, kind in zip(elements.vertices, elements.valid, elements.kind, strict=True):
            predicted_lines.append(vertices[valid].double().numpy())
            kinds.append(int(kind))
            number.append(n)
    count = len(predicted_lines)
    true = LineSet(
        np.array(number, dtype=np.int64), np.array(kinds, dtype=np.int64), predicted_lines, np.ones(count)
    )
    names = [frame.name for frame in frames]
    return MapFiles(lines, true, names, np.array([frame.drive for frame in frames]), area, 0, short)


def _in_order(frames: Mapping[str, _Frame]) -> list[str]:
    """Return tokens by drive and time if the file has both, else in its order."""
    if any(frame.drive is None or frame.index is None for frame in frames.values()):
        return list(frames)
    return sorted(frames, key=lambda token: (str(frames[token].drive), frames[token].index or 0))


def _line_set(frames: Sequence[_Frame | None]) -> tuple[LineSet, int]:
    """Return the elements of frames in order, and the number of those without two points."""
    rows = [(n, e) for n, frame in enumerate(frames) if frame is not None for e in frame.elements]
    kept = [(n, e) for n, e in rows if len(e.points) >= 2]
    identities = [e.identity for _, e in kept]
    # Identities count only if every element has one
    tracked = bool(kept) and all(identity is not None for identity in identities)
    return (
        LineSet(
            frame=np.array([n for n, _ in kept], dtype=np.int64),
            kind=np.array([int(e.kind) for _, e in kept], dtype=np.int64),
            lines=[e.points for _, e in kept],
            score=np.array([e.score for _, e in kept], dtype=np.float64),
            identity=np.array(identities, dtype=np.int64) if tracked else None,
        ),
        len(rows) - len(kept),
    )


def _read(path: Path, *, predicted: bool) -> tuple[dict[str, _Frame], Area | None]:
    """Return the frames of a file by token, and the area that it states."""
    content = read_plain(path)
    frames: dict[str, _Frame] = {}
    area: Area | None = None
    try:
        if isinstance(content, dict):
            area = _stated_area(content.get("meta"))
            # MapTR's truth lists its frames under "GTs"
            content = content.get("results", content.get("GTs", content))
        if isinstance(content, list):
            frame_lines: Iterator[tuple[str, _Frame]] = _of_maptr(content, predicted)
        elif isinstance(content, dict):
            frame_lines = _of_streammapnet(content, predicted)
        else:
            raise InputError("neither frames in a list (MapTR) nor by token (StreamMapNet)")
        for token, frame in frame_lines:
            if token in frames:
                raise InputError(f"frame {token} is there twice")
            _check_identities(token, frame)
            frames[token] = frame
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return frames, area


def _stated_area(meta: Any) -> Area | None:
    """Return the area that `meta` states as `area_m`: metres along x and y."""
    if not isinstance(meta, dict) or "area_m" not in meta:
        return None
    for area, half_xy_m in HALF_XY_M.items():
        if meta["area_m"] == [2 * half_m for half_m in half_xy_m]:
            return area
    raise InputError(f"meta: the area_m {meta['area_m']!r} is neither [60, 30] nor [100, 50]")


def _of_maptr(content: Sequence[Any], predicted: bool) -> Iterator[tuple[str, _Frame]]:
    for n, record in enumerate(content):
        if not isinstance(record, dict) or not isinstance(record.get("sample_token"), str):
            raise InputError(f"frame {n} has no sample_token")
        token, vectors = record["sample_token"], record.get("vectors")
        if not isinstance(vectors, list) or not all(isinstance(vector, dict) for vector in vectors):
            raise InputError(f"frame {token} has no list of vectors")
        elements = []
        for i, vector in enumerate(vectors):
            where = f"frame {token}, vector {i}"
            kind = _KINDS.get(vector.get("cls_name"))
            if kind is None:
                raise InputError(
                    f"{where}: the class {vector.get('cls_name')!r} is not one of {', '.join(_KINDS)}"
                )
            score = _score(vector.get("confidence_level"), where) if predicted else 1.0
            identity = _identity(vector.get("global_id"), where)
            elements.append(_Element(where, kind, _points(vector.get("pts"), where), score, identity))
        yield token, _Frame(elements, *_place(record))


# StreamMapNet's records have parallel lists instead of vectors
def _of_streammapnet(content: Mapping[str, Any], predicted: bool) -> Iterator[tuple[str, _Frame]]:
    for token, record in content.items():
        lists = ["vectors", "labels", *(["scores"] if predicted else [])]
        stated = [record.get(name) if isinstance(record, dict) else None for name in lists]
        columns = [column for column in stated if isinstance(column, list)]
        if len(columns) != len(lists):
            raise InputError(f"frame {token} lacks one of the lists {', '.join(lists)}")
        if len({len(column) for column in columns}) != 1:
            raise InputError(f"frame {token}: its lists {', '.join(lists)} differ in length")
        identities = record.get("global_ids", [None] * len(columns[0]))
        if not isinstance(identities, list) or len(identities) != len(columns[0]):
            raise InputError(f"frame {token}: its global_ids are not as many as its vectors")
        elements = []
        for i, (points, label) in enumerate(zip(*columns[:2], strict=True)):
            where = f"frame {token}, vector {i}"
            if not isinstance(label, int) or isinstance(label, bool) or not 0 <= label < len(_BY_LABEL):
                raise InputError(
                    f"{where}: the label {label!r} is not one of 0 (crossing), 1 (divider), 2 (boundary)"
                )
            score = _score(columns[2][i], where) if predicted else 1.0
            identity = _identity(identities[i], where)
            elements.append(_Element(where, _BY_LABEL[label], _points(points, where), score, identity))
        yield token, _Frame(elements, *_place(record))


def _place(record: Mapping[str, Any]) -> tuple[str | None, int | None]:
    """Return drive and index of a frame, where the file has them."""
    drive, index = record.get("scene_name"), record.get("local_idx")
    return (
        drive if isinstance(drive, str) else None,
        index if isinstance(index, int) and not isinstance(index, bool) else None,
    )


def _points(value: Any, where: str) -> Float[ndarray, "V 2"]:
    """Return x and y. MapTracker's stored vectors are flat lists of them; a third coordinate is left out."""
    try:
        points = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{where}: its points are not numbers") from error
    # Flat lists hold x and y by turns
    if points.ndim == 1 and len(points) % 2 == 0:
        points = points.reshape(-1, 2)
    if points.ndim != 2 or points.shape[1] not in (2, 3):
        raise InputError(f"{where}: its points are not pairs of x and y")
    if not (np.abs(points) <= MAX_M).all():
        raise InputError(f"{where} has a point that is not finite, or beyond {MAX_M:g} m")
    return points[:, :2]


def _score(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise InputError(f"{where}: the score {value!r} is not a finite number")
    return float(value)


def _identity(value: Any, where: str) -> int | None:
    if value is None or (isinstance(value, int) and not isinstance(value, bool)):
        return value
    raise InputError(f"{where}: the identity {value!r} is not a whole number")


def _check_identities(token: str, frame: _Frame) -> None:
    seen: set[tuple[ElementKind, int]] = set()
    for element in frame.elements:
        if element.identity is None:
            continue
        key = (element.kind, element.identity)
        if key in seen:
            raise InputError(f"{element.where}: identity {element.identity} is in frame {token} twice")
        seen.add(key)
