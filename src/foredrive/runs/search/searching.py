"""Query an index with the towers that made it."""

from collections.abc import Sequence

from foredrive.data.clip_list import ListedClip, clip_list
from foredrive.runs.search.towers import find_towers
from foredrive.search.find import Found, Hit, find
from foredrive.search.index import FrameIndex
from foredrive.search.query import Query
from foredrive.search.target import Target, example_target, text_target


def ask(index: FrameIndex, query: Query, towers: str | None = None, *, ensemble: bool = True) -> Found:
    """Return the hits of a query.

    Args:
        towers: folder or name of the towers that made the index; by default as noted in the index.
        ensemble: whether to embed each text in several wordings.

    Raises:
        InputError: the towers are not those of the index; the query cannot be answered.
    """
    return find(index, query, _target(index, query, towers, ensemble))


def _target(index: FrameIndex, query: Query, towers: str | None, ensemble: bool) -> Target | None:
    if not query.compares:
        return None
    chosen = find_towers(towers or index.settings.towers)
    index.check_towers(chosen.name, chosen.fingerprint)
    if query.example is not None:
        return example_target(index, query.example, chosen)
    return text_target(query, chosen, ensemble=ensemble)


def listed_clips(hits: Sequence[Hit], before_s: float, after_s: float) -> dict[str, object]:
    """Return the hits as a list of clips (`data.clip_list`), each from `before_s` before to `after_s`
    after.
    """
    clips, notes = [], []
    for hit in hits:
        row = hit.row
        start_s, end_s = max(0.0, row.t_s - before_s), row.t_s + after_s
        clips.append(ListedClip(row.folder, row.maps_dir, start_s, end_s))
        notes.append({"log": row.log, "t_s": row.t_s, "view": row.view, "score": hit.score})
    return clip_list(clips, notes)
