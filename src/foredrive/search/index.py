"""An index of logs: a LanceDB table with one row per moment and view, and its provenance."""

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
"""Maximum number of rows for exact comparison. Above it, approximate search finds candidates first."""
KEPT_VERSIONS = datetime.timedelta(hours=1)
"""Time for which old versions are kept, so that concurrent readers can finish."""
PARTITION_ROWS, GROWN = 4096, 2
"""Number of rows per partition, and the growth factor of the table at which partitions are reconstructed."""
PROBES, REFINEMENT = 32, 3
"""Number of partitions searched, and the factor of additional rows compared exactly. The factor is needed
because partitions store vectors with 8 bits."""
SAMPLE_BLOCKS = 16
FRAMES, PARTS = "frames", "parts"
_REMEMBERED = b"foredrive"
_PART_SCHEMA = pa.schema(
    [("log", pa.string()), ("first", pa.int32()), ("last", pa.int32()), ("digest", pa.string())]
)
BAD_VECTORS = "null"
"""Rows may lack an embedding. By default LanceDB rejects them."""
Scores = Mapping[str, Mapping[str, float]]
"""Scores by the key of a moment, then by the names in `rows.SCORES`."""
SCORED_AT_ONCE = 2000
"""Number of moments whose rows are rewritten together."""


@dataclass(frozen=True)
class IndexSettings:
    """Settings that all rows of an index have in common."""

    towers: str
    fingerprint: str
    dim: int
    stride_s: float


class Part(NamedTuple):
    """Frames of a log that were indexed together."""

    log: str
    first: int
    last: int
    digest: str
    """Digest of the log's files."""


class FrameIndex:
    """An open index.

    Args:
        uri: a folder or a location on object storage.

    Raises:
        InputError: there is no index, or it is not one of Foredrive.
    """

    settings: IndexSettings

    def __init__(self, uri: str) -> None:
        self.uri = uri
        table = find_table(uri, FRAMES)
        if table is None:
            raise InputError(f"{uri}: no index here; foredrive search index LOGS --index {uri} makes one")
        self._frames = table
        metadata = (table.schema.metadata or {}).get(_REMEMBERED)
        if metadata is None:
            raise InputError(f"{uri}: the table {FRAMES} was not made by Foredrive")
        self.settings = IndexSettings(**json.loads(metadata))

    @classmethod
    def make(cls, uri: str, settings: IndexSettings) -> "FrameIndex":
        """Open an index for adding rows, or create it.

        Raises:
            InputError: an index exists that was made with other towers or another stride.
        """
        if find_table(uri, FRAMES) is None:
            # The settings are stored in the metadata of the table's schema
            schema = row_schema(settings.dim).with_metadata({_REMEMBERED: json.dumps(asdict(settings))})
            make_table(uri, FRAMES, schema)
        index = cls(uri)
        index.check_towers(settings.towers, settings.fingerprint)
        if index.settings.stride_s != settings.stride_s:
            raise InputError(
                f"{uri}: has a moment every {index.settings.stride_s:g} s of its logs, "
                f"not {settings.stride_s:g} s"
            )
        return index

    def check_towers(self, name: str, fingerprint: str) -> None:
        """Check that embeddings of these towers can be compared with those of the index.

        Raises:
            InputError: the index was made by other towers.
        """
        ours = self.settings
        if ours.fingerprint != fingerprint:
            raise InputError(
                f"{self.uri}: made by the towers {ours.towers} ({ours.fingerprint}), not by {name} "
                f"({fingerprint}): their embeddings cannot be compared; index the logs again in another place"
            )

    def parts(self) -> set[Part]:
        """Return the parts in the index."""
        return {Part(**row) for row in all_rows(find_table(self.uri, PARTS))}  # type: ignore[arg-type]

    def add(self, parts: Sequence[tuple[Part, pa.Table]]) -> None:
        """Add parts. Rows of the same moments, e.g. from an interrupted call, are replaced."""
        rows = pa.concat_tables([rows for _, rows in parts])
        part_table = pa.Table.from_pylist([part._asdict() for part, _ in parts], schema=_PART_SCHEMA)
        with naming(self.uri):
            # The list of parts is written last: the next call replaces what an interrupted one has added
            self._frames.delete(f"key IN ({quoted_list(rows['key'].unique().to_pylist())})")
            self._frames.add(rows, on_bad_vectors=BAD_VECTORS)
            make_table(self.uri, PARTS, _PART_SCHEMA).add(part_table)

    def drop(self, log: str) -> None:
        """Remove a log, because it has changed."""
        table = find_table(self.uri, PARTS)
        # Before the rows, so that no log without rows is listed as indexed
        if table is not None:
            table.delete(f"log = {quoted(log)}")
        self._frames.delete(f"log = {quoted(log)}")

    def compact(self) -> None:
        """Merge small files, delete old versions and add new rows to the existing partitions."""
        with naming(self.uri):
            self._frames.optimize(cleanup_older_than=KEPT_VERSIONS)

    def optimise(self, *, exact_up_to: int = EXACT_UP_TO) -> None:
        """Compact the index, and partition large tables by their embeddings for fast search.

        Args:
            exact_up_to: maximum number of rows without partitions.
        """
        self.compact()
        if self.count() > exact_up_to:
            for name in EMBEDDINGS:
                rows = self.count(f"{name} IS NOT NULL")
                if rows > exact_up_to:
                    self._partition(name, max(1, rows // PARTITION_ROWS))

    def _partition(self, column: str, partitions: int) -> None:
        """Partition the rows by an embedding, unless there are partitions of about the right number.

        The number of partitions is stored in the name of the index.
        """
        from lancedb.index import IvfSq

        names = [index.name for index in self._frames.list_indices() if column in index.columns]
        if any(partitions < GROWN * int(name.removeprefix(f"{column}_")) for name in names):
            return
        # The new partitions are ready before the old ones are dropped, so that searches stay fast
        config = IvfSq(distance_type="cosine", num_partitions=partitions)
        self._frames.create_index(column, config=config, name=f"{column}_{partitions}")
        for name in names:
            self._frames.drop_index(name)

    def count(self, where: str | None = None) -> int:
        """Count the rows that satisfy an SQL condition.

        Raises:
            InputError: the condition cannot be parsed, or names an unknown column.
        """
        with understanding(where):
            return int(self._frames.count_rows(where))

    def select(self, where: str | None, columns: Sequence[str]) -> pa.Table:
        """Return the rows that satisfy a condition.

        Raises:
            InputError: as `count`.
        """
        query = self._frames.search().select(list(columns)).limit(None)
        with understanding(where):
            return (query if where is None else query.where(where)).to_arrow()

    def sample(self, columns: Sequence[str], count: int) -> pa.Table:
        """Return about `count` rows, from places that are spread evenly over the table."""
        rows = self.count()
        if rows <= count:
            return self.select(None, columns)
        block = -(-count // SAMPLE_BLOCKS)
        query = self._frames.search().select(list(columns)).limit(block)
        with naming(self.uri):
            starts = np.linspace(0, rows - block, SAMPLE_BLOCKS).astype(int).tolist()
            return pa.concat_tables([query.offset(start).to_arrow() for start in starts])

    def nearest(
        self, vector: Float[np.ndarray, "D"], to: str, where: str | None, columns: Sequence[str], limit: int
    ) -> pa.Table:
        """Return approximately the `limit` rows whose embedding `to` is nearest to a unit vector.

        Raises:
            InputError: as `count`.
        """
        query = self._frames.search(vector, vector_column_name=to).distance_type("cosine")
        query = query.select([*columns, "_distance"]).limit(limit)
        # More partitions are searched if the condition leaves too few rows; 0 is no limit
        query = query.minimum_nprobes(PROBES).maximum_nprobes(0)
        # The stored 8-bit vectors select more rows than asked for, which are compared again exactly
        query = query.refine_factor(REFINEMENT)
        with understanding(where):
            # The condition is applied before the search. Afterwards it could leave fewer rows than asked for
            hits = (query if where is None else query.where(where, prefilter=True)).to_arrow()
        return hits.select(list(columns))

    def set_scores(self, scores: Scores) -> int:
        """Replace the scores of moments. Return the number of changed rows."""
        changed = 0
        keys = list(scores)
        for start in range(0, len(keys), SCORED_AT_ONCE):
            where = f"key IN ({quoted_list(keys[start : start + SCORED_AT_ONCE])})"
            rows = self.select(where, row_schema(self.settings.dim).names)
            if not len(rows):
                continue
            for name in SCORES:
                field = FACTS.field(f"score_{name}")
                values = [scores[key].get(name) for key in rows["key"].to_pylist()]
                column = rows.schema.get_field_index(field.name)
                rows = rows.set_column(column, field, pa.array(values, field.type))
            with naming(self.uri):
                # One transaction: a process stopped between deleting and adding would lose the rows
                replacing = self._frames.merge_insert(["key", "view"]).when_matched_update_all()
                replacing.execute(rows, on_bad_vectors=BAD_VECTORS)
            changed += len(rows)
        return changed
