"""Clip list files: parts of logs selected by a search or by hand."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from foredrive.errors import InputError
from foredrive.files import atomic_path

FORMAT = "foredrive clips 1"


@dataclass(frozen=True)
class ListedClip:
    """A selected part of a log."""

    folder: Path
    maps_dir: Path
    start_s: float
    """Start, s since the start of the log."""
    end_s: float
    """End (exclusive), s since the start of the log."""


def clip_list(
    clips: Sequence[ListedClip], notes: Sequence[Mapping[str, object]] | None = None
) -> dict[str, object]:
    """Return a list in the format of its file.

    Args:
        notes: additional entries for each clip. They are not read back.
    """
    all_notes = notes if notes is not None else [{} for _ in clips]
    entries = [
        {
            "folder": str(clip.folder), "maps_dir": str(clip.maps_dir),
            "start_s": clip.start_s, "end_s": clip.end_s, **note,
        }
        for clip, note in zip(clips, all_notes, strict=True)
    ]  # fmt: skip
    return {"format": FORMAT, "clips": entries}


def write_clip_list(path: Path, listed: Mapping[str, object]) -> None:
    """Write the result of `clip_list` to a file."""
    with atomic_path(path) as scratch:
        scratch.write_text(json.dumps(listed, indent=1) + "\n")


def read_clip_list(path: Path) -> list[ListedClip]:
    """Read a clip list. Relative folders are relative to the folder of the list.

    Raises:
        InputError: the file is not a clip list, or it has no clips.
    """
    try:
        written = json.loads(path.read_bytes())
        if written["format"] != FORMAT:
            raise InputError(f"{path}: not a list of clips ({FORMAT}), but {written['format']!r}")
        clips = [
            ListedClip(
                path.parent / entry["folder"],
                path.parent / entry["maps_dir"],
                float(entry["start_s"]),
                float(entry["end_s"]),
            )
            for entry in written["clips"]
        ]
    except InputError:
        raise
    except (OSError, ValueError, LookupError, TypeError, RecursionError) as error:
        raise InputError(f"{path}: not a list of clips ({FORMAT}): {error}") from error
    if not clips:
        raise InputError(f"{path}: the list has no clips")
    for clip in clips:
        if not clip.start_s < clip.end_s:
            raise InputError(f"{path}: a clip of {clip.folder} ends at {clip.end_s:g} s, before it starts")
    return clips
