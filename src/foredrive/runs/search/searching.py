"""Query an index with the towers that made it."""

import dataclasses
from collections.abc import Sequence

from foredrive.data.clip_list import ListedClip, clip_list
from foredrive.runs.search.towers import find_towers, unseen_text
from foredrive.search.embedded import SENTENCE
from foredrive.search.find import Found, Hit, find
from foredrive.search.index import FrameIndex
from foredrive.search.logic_words import logic_note
from foredrive.search.query import Query
from foredrive.search.resemblance import resembles
from foredrive.search.target import example_target, text_target


def ask(index: FrameIndex, query: Query, towers: str | None = None, *, ensemble: bool = True) -> Found:
    """Return the hits of a query.

    Args:
        towers: folder or name of the towers that made the index; by default as noted in the index.
        ensemble: whether to embed each text in several wordings.

    Raises:
        InputError: the towers are not those of the index; the query cannot be answered.
    """
    if not query.compares:
        return find(index, query, None)
    chosen = find_towers(towers or index.settings.towers)
    index.check_towers(chosen.name, chosen.fingerprint)
    if query.example is not None:
        return find(index, query, example_target(index, query.example, chosen))
    target = text_target(query, chosen, ensemble=ensemble)
    result = find(index, query, target)
    asked = target.lidar if query.modality == "lidar" else target.image
    # With towers of other programs it was not measured whether this tells anything
    if asked is None or not chosen.fingerprint.startswith(SENTENCE):
        return result
    return dataclasses.replace(result, unlike=resembles(index, asked, chosen) is False)


def answer_notes(index: FrameIndex, query: Query, towers: str | None, result: Found) -> list[str]:
    """Return lines that say why the hits of a query may be none, or not what its text asks for."""
    said = logic_note((query.text, query.image_text, query.lidar_text), query.where)
    notes = [] if said is None else [said]
    if query.compares and result.hits:
        name, logs = towers or index.settings.towers, [hit.row.log for hit in result.hits]
        notes += [text] if (text := unseen_text(name, query.modality != "image", logs)) else []
    if result.unlike:
        notes.append(
            "nothing in the index resembles the text: unrelated texts resemble it as much. These are the "
            "nearest moments, not hits"
        )
    return notes


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
