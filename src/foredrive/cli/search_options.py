"""Options of `foredrive search`, in groups: the query, the moments, the ranking, and the use of the hits."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from foredrive.cli.arguments import OptionalPath, check_number
from foredrive.errors import InputError

if TYPE_CHECKING:
    from foredrive.search.find import Found
    from foredrive.search.query import Query

Place = Annotated[str, tyro.conf.arg(metavar="PATH|URL")]
Text = Annotated[str | None, tyro.conf.arg(metavar="TEXT")]
Name = Annotated[str | None, tyro.conf.arg(metavar="NAME")]
Seconds = Annotated[float, tyro.conf.arg(metavar="SECONDS")]


def check_index(place: str) -> None:
    """Check that an index can exist. Raise `InputError` if a local folder does not exist."""
    if "://" not in place and not Path(place).is_dir():
        raise InputError(f"{place}: no index here; foredrive search index LOGS --index {place} makes one")


@dataclass(frozen=True)
class QueryOptions:
    """What to look for.

    Args:
        text: Text to look for, such as "pedestrian crossing at night".
        like: Find moments that are similar to a moment (LOG@12.5s), one view of it (LOG@12.5s/VIEW) or a part
            of a view (LOG@12.5s/VIEW:LEFT,TOP,RIGHT,BOTTOM in px); LOG is the name of an indexed log or a
            log's folder.
        modality: Compare with images, with sweeps, or with both.
        rule: How images and sweeps are combined: the sum of features, the sum of logits, or the best by image
            ranked again by lidar.
        image_text: Compare images with this text instead.
        lidar_text: Compare sweeps with this text instead.
        plain: Use texts as they are; by default each text is worded in several ways.
    """

    text: tyro.conf.Positional[Text] = None
    like: Annotated[str | None, tyro.conf.arg(metavar="LOG@12.5s")] = None
    modality: Literal["image", "lidar", "joint"] = "image"
    rule: Literal["features", "logits", "rerank"] = "features"
    image_text: Text = None
    lidar_text: Text = None
    plain: bool = False


@dataclass(frozen=True)
class ConditionOptions:
    """Which moments to search.

    Args:
        where: A condition on the columns of the index, such as "ego_speed > 5 AND weather = 'rain'";
            docs/search.md lists the columns.
        tagged: Search only moments that have this tag.
        view: any, sectors, all (whole scenes) or the name of a camera.
    """

    where: Annotated[str | None, tyro.conf.arg(metavar="SQL")] = None
    tagged: Name = None
    view: str = "any"


@dataclass(frozen=True)
class RankingOptions:
    """Which hits to return, and in what order.

    Args:
        top: Number of hits.
        gap: Moments of one log that are closer than this count as one hit, s.
        diverse: From the best ten times as many hits, choose those that differ most (k-centre), or those that
            represent most of the others.
        by: Rank also by a column of numbers, such as score_missed; without a text, rank by this column alone.
        mix: Weight of that column relative to similarity, 0 to 1.
    """

    top: int = 20
    gap: Seconds = 5.0
    diverse: Literal["no", "k-centre", "facility"] = "no"
    by: Annotated[str | None, tyro.conf.arg(metavar="COLUMN")] = None
    mix: float = 0.5


@dataclass(frozen=True)
class HitOptions:
    """What to do with the hits.

    Args:
        out: Write a contact sheet: PNG or HTML.
        clips: Write the hits as a list of clips, which `foredrive train --logs` and other verbs accept as
            logs.
        before: Length of such a clip before its hit, s.
        after: Length of such a clip after its hit, s.
        tag: Give all hits this tag.
        save: Save this query under a name.
    """

    out: OptionalPath = None
    clips: OptionalPath = None
    before: Seconds = 2.0
    after: Seconds = 4.0
    tag: Name = None
    save: Name = None

    def check(self) -> None:
        """Raise `InputError` for output that cannot be written, before the search begins."""
        check_number("--before", self.before, low=0)
        check_number("--after", self.after, low=0)
        if not self.before + self.after > 0:
            raise InputError("--before and --after are 0: such a clip is empty")
        if self.out is not None and self.out.suffix not in (".png", ".html"):
            raise InputError(f"{self.out}: a contact sheet ends on .png or .html")

    def do(self, index: str, query: "Query", result: "Found") -> None:
        """Save the query, tag the hits, and write the files."""
        from foredrive.data.clip_list import write_clip_list
        from foredrive.runs.search.searching import listed_clips
        from foredrive.search.saved import add_tag, save_query
        from foredrive.view.search_sheet import write_search_sheet

        if self.save is not None:
            save_query(index, self.save, query.to_json())
        if self.tag is not None:
            add_tag(index, self.tag, [hit.row.key for hit in result.hits])
        if not result.hits:
            return
        if self.clips is not None:
            write_clip_list(self.clips, listed_clips(result.hits, self.before, self.after))
            print(f"wrote {self.clips}: foredrive train RECIPE --logs {self.clips}")
        if self.out is not None:
            write_search_sheet(self.out, query, result.hits, result.unlike)
            print(f"wrote {self.out}")


def as_query(query: QueryOptions, condition: ConditionOptions, ranking: RankingOptions) -> "Query":
    """Return the query of the options. Raise `InputError` as `Query` does."""
    from foredrive.search.query import Query

    return Query(
        text=query.text,
        image_text=query.image_text,
        lidar_text=query.lidar_text,
        like=query.like,
        modality=query.modality,
        rule=query.rule,
        where=condition.where,
        tag=condition.tagged,
        view=condition.view,
        top=ranking.top,
        gap_s=ranking.gap,
        diverse=None if ranking.diverse == "no" else ranking.diverse,
        by=ranking.by,
        mix=ranking.mix,
    )
