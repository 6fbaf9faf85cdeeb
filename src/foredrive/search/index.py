"""An index of logs: a LanceDB table with a row for each moment and view, which remembers how it was made."""

import datetime
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import NamedTuple

import numpy as np
import pyarrow as pa
from jaxtyping import Float

from foredrive.errors import InputError
from foredrive.files import naming
from foredrive.search.rows import EMBEDDINGS, FACTS, SCORES, row_schema
from foredrive.search.tables import all_rows, find_table, make_table, quoted, quoted_list, understanding

EXACT_UP_TO = 100_000
"""So many rows are compared one by one; of more, those near a query are looked up and then compared."""
KEPT_VERSIONS = datetime.timedelta(hours=1)
"""Whoever reads meanwhile has so long to finish."""
PARTITION_ROWS, GROWN = 4096, 2
"""Rows that lie together around a centre; centres are chosen anew once rows are so many times as many."""
PROBES, REFINEMENT = 32, 3
"""Partitions that are looked through, and how many times as many rows as are wanted are then compared in
full: partitions know vectors to 8 bits."""
FRAMES, PARTS = "frames", "parts"
_REMEMBERED = b"foredrive"
_PART_SCHEMA = pa.schema(
    [("log", pa.string()), ("first", pa.int32()), ("last", pa.int32()), ("digest", pa.string())]
)
Scores = Mapping[str, Mapping[str, float]]
"""By the key of a moment, and the names in `rows.SCORES`."""
SCORED_AT_ONCE = 2000
"""Moments whose rows are written anew together."""


@dataclass(frozen=True)
class Making:
    """How the rows of an index were made; all of them alike."""

    towers: str
    fingerprint: str
    dim: int
    stride_s: float


class Part(NamedTuple):
    """Some frames of a log, indexed together."""

    log: str
    first: int
    last: int
    digest: str
    """Of the log's files."""


class FrameIndex:
    """An index that is open.

    Args:
        uri: a folder or a place on object storage.

    Raises:
        InputError: there is none, or it is not one of ours.
    """

    making: Making

    def __init__(self, uri: str) -> None:
        self.uri = uri
        table = find_table(uri, FRAMES)
        if table is None:
            raise InputError(f"{uri}: no index here; foredrive search index LOGS --index {uri} makes one")
        self._frames = table
        told = (table.schema.metadata or {}).get(_REMEMBERED)
        if told is None:
            raise InputError(f"{uri}: its table {FRAMES} is none of Foredrive's")
        self.making = Making(**json.loads(told))

    @classmethod
    def make(cls, uri: str, making: Making) -> "FrameIndex":
        """Open an index to add to, or begin one.

        Raises:
            InputError: there is one that was made otherwise.
        """
        if find_table(uri, FRAMES) is None:
            schema = row_schema(making.dim).with_metadata({_REMEMBERED: json.dumps(asdict(making))})
            make_table(uri, FRAMES, schema)
        index = cls(uri)
        index.check_towers(making.towers, making.fingerprint)
        if index.making.stride_s != making.stride_s:
            raise InputError(
                f"{uri}: has a moment every {index.making.stride_s:g} s of its logs, "
                f"not {making.stride_s:g} s"
            )
        return index

    def check_towers(self, name: str, fingerprint: str) -> None:
        """Whether what towers embed can be compared with what is here.

        Raises:
            InputError: other towers made this index.
        """
        ours = self.making
        if ours.fingerprint != fingerprint:
            raise InputError(
                f"{self.uri}: made by the towers {ours.towers} ({ours.fingerprint}), not by {name} "
                f"({fingerprint}): their embeddings cannot be compared"
            )

    def parts(self) -> set[Part]:
        """What is in."""
        return {Part(**row) for row in all_rows(find_table(self.uri, PARTS))}  # type: ignore[arg-type]

    def add(self, parts: Sequence[tuple[Part, pa.Table]]) -> None:
        """Put parts in; rows of the same moments, which an interrupted call has left, give way."""
        rows = pa.concat_tables([rows for _, rows in parts])
        told = pa.Table.from_pylist([part._asdict() for part, _ in parts], schema=_PART_SCHEMA)
        with naming(self.uri):
            self._frames.delete(f"key IN ({quoted_list(rows['key'].unique().to_pylist())})")
            self._put(rows)
            make_table(self.uri, PARTS, _PART_SCHEMA).add(told)

    def drop(self, log: str) -> None:
        """Take a log out: it has changed."""
        table = find_table(self.uri, PARTS)
        if table is not None:  # first: a log whose rows are gone must not count as in
            table.delete(f"log = {quoted(log)}")
        self._frames.delete(f"log = {quoted(log)}")

    def compact(self) -> None:
        """Merge small files and drop old versions; put new rows into partitions that there are."""
        with naming(self.uri):
            self._frames.optimize(cleanup_older_than=KEPT_VERSIONS)

    def optimise(self, *, exact_up_to: int = EXACT_UP_TO) -> None:
        """Compact, and partition the rows of which there are many by what they are looked up by.

        Args:
            exact_up_to: so many rows need no partitions.
        """
        self.compact()
        if self.count() > exact_up_to:
            for name in EMBEDDINGS:
                rows = self.count(f"{name} IS NOT NULL")
                if rows > exact_up_to:
                    self._partition(name, max(1, rows // PARTITION_ROWS))

    def _partition(self, column: str, partitions: int) -> None:
        """Partition the rows by an embedding, unless they are: how many there were then is in its name."""
        from lancedb.index import IvfSq

        there = [index.name for index in self._frames.list_indices() if column in index.columns]
        if any(partitions < GROWN * int(name.removeprefix(f"{column}_")) for name in there):
            return
        config = IvfSq(distance_type="cosine", num_partitions=partitions)
        self._frames.create_index(column, config=config, name=f"{column}_{partitions}")
        for name in there:
            self._frames.drop_index(name)

    def count(self, where: str | None = None) -> int:
        """Rows for which a condition in SQL holds.

        Raises:
            InputError: it does not parse, or names a column that there is not.
        """
        with understanding(where):
            return int(self._frames.count_rows(where))

    def select(self, where: str | None, columns: Sequence[str]) -> pa.Table:
        """Rows for which a condition holds. Raises `InputError` as `count`."""
        query = self._frames.search().select(list(columns)).limit(None)
        with understanding(where):
            return (query if where is None else query.where(where)).to_arrow()

    def nearest(
        self, vector: Float[np.ndarray, "D"], to: str, where: str | None, columns: Sequence[str], limit: int
    ) -> pa.Table:
        """Nearly all of the `limit` rows whose embedding `to` lies nearest to a unit vector.

        Raises `InputError` as `count`.
        """
        query = self._frames.search(vector, vector_column_name=to).distance_type("cosine")
        query = query.select([*columns, "_distance"]).limit(limit)
        query = query.minimum_nprobes(PROBES).maximum_nprobes(0)  # more, if conditions leave too few
        query = query.refine_factor(REFINEMENT)
        with understanding(where):
            found = (query if where is None else query.where(where, prefilter=True)).to_arrow()
        return found.select(list(columns))

    def set_scores(self, scores: Scores) -> int:
        """Give moments their scores, in place of those they had; how many rows there are of them."""
        changed = 0
        keys = list(scores)
        for start in range(0, len(keys), SCORED_AT_ONCE):
            where = f"key IN ({quoted_list(keys[start : start + SCORED_AT_ONCE])})"
            rows = self.select(where, row_schema(self.making.dim).names)
            if not len(rows):
                continue
            for name in SCORES:
                field = FACTS.field(f"score_{name}")
                values = [scores[key].get(name) for key in rows["key"].to_pylist()]
                at = rows.schema.get_field_index(field.name)
                rows = rows.set_column(at, field, pa.array(values, field.type))
            self._frames.delete(where)
            self._put(rows)
            changed += len(rows)
        return changed

    def _put(self, rows: pa.Table) -> None:
        self._frames.add(rows, on_bad_vectors="null")  # else it takes rows without an embedding for mistakes
