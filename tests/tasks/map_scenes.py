"""Vector maps for tests: by hand, and random ones."""

from collections.abc import Sequence

import numpy as np

from foredrive.scene.map_elements import ElementKind
from foredrive.tasks.maps.lines import LineSet


def elements(
    lines: Sequence[Sequence[tuple[float, float]]],
    kind: int | Sequence[int] = ElementKind.DIVIDER,
    frame: int | Sequence[int] = 0,
    score: float | Sequence[float] = 1.0,
    identity: Sequence[int] | None = None,
) -> LineSet:
    n = len(lines)
    return LineSet(
        frame=np.broadcast_to(np.asarray(frame), n).copy(),
        kind=np.broadcast_to(np.asarray(kind), n).copy(),
        lines=[np.array(line, dtype=float) for line in lines],
        score=np.broadcast_to(np.asarray(score, dtype=float), n).copy(),
        identity=None if identity is None else np.array(identity),
    )


def random_maps(rng: np.random.Generator, frames: int = 5, lost: float = 0.3) -> tuple[LineSet, LineSet]:
    """Curves with identities; predictions that follow most of them, lose their identity, or are clutter."""
    lines, kinds, frame, identity = [], [], [], []
    found, found_kind, found_frame, found_identity = [], [], [], []
    for f in range(frames):
        for n in range(int(rng.integers(0, 8))):
            x = np.sort(rng.uniform(-30, 30, int(rng.integers(2, 9))))
            line = np.column_stack([x, rng.uniform(-14, 14) + rng.normal(0, 0.4, len(x))])
            kind = int(rng.integers(0, 3))
            lines.append(line)
            kinds.append(kind)
            frame.append(f)
            identity.append(n)
            for copy in range(int(rng.integers(0, 3))):
                found.append(line + rng.normal(0, 0.7, 2) + rng.normal(0, 0.3, line.shape))
                found_kind.append(kind)
                found_frame.append(f)
                found_identity.append(100 * copy + n + 1000 * int(rng.random() < lost))
        for n in range(2):
            found.append(rng.uniform(-14, 14, (3, 2)))
            found_kind.append(int(rng.integers(0, 3)))
            found_frame.append(f)
            found_identity.append(5000 + n)
    score = rng.permutation(len(found)) / len(found)
    predicted = elements(found, found_kind, found_frame, score, found_identity)
    keys = np.stack([predicted.frame, predicted.kind, found_identity])
    once = np.unique(keys, axis=1, return_index=True)[1]
    return predicted[once], elements(lines, kinds, frame, 1.0, identity)
