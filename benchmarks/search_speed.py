"""Query time and recall over a million embeddings, and memory for building the index.

LanceDB as `foredrive.search` uses it is compared with exhaustive search in NumPy and FAISS, and with FAISS'
partitions of 8-bit vectors, as LanceDB has them.

The embeddings are synthetic. Like those of image towers, they are directions of falling variance about a
common mean. They are grouped in kinds of scenes, drives of a kind, and consecutive moments of a drive. Half
of the queries are moments that are not in the index; the other half lie off to one side of all of them, as
texts do.

It needs 4 GiB of disk while it runs. SEARCH_SPEED_ROWS sets a smaller number of rows for a trial.
"""

import os
import tempfile
import time
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from statistics import median

import numpy as np
import pyarrow as pa

from benchmarks.common.benchmark import Benchmark
from benchmarks.common.measuring import held_mib
from foredrive.engine.provenance import peak_rss_gib
from foredrive.runs.search.indexing import IndexWriter
from foredrive.search.find import find
from foredrive.search.index import PARTITION_ROWS, PROBES, REFINEMENT, FrameIndex, IndexSettings, Part
from foredrive.search.query import Query
from foredrive.search.rows import row_schema
from foredrive.search.target import Target

ROWS = int(os.environ.get("SEARCH_SPEED_ROWS", "1000000"))
DIM, KINDS, DRIVE = 384, 300, 400
"""Dimension, number of kinds of scenes, and rows of a drive: 57 moments of seven views."""
MEAN, KIND, ALONG, NOISE = 0.6, 0.55, 0.3, 0.25
"""Lengths of the components of an embedding: two random moments have a cosine of about 0.4."""
ASIDE = 0.8
QUERIES, TOP = 60, 20


def spectrum(rng: np.random.Generator, count: int) -> np.ndarray:
    """Draw random vectors of length about 1 whose variance falls as 1 / (1 + k / 20)."""
    scale = 1 / np.sqrt(1 + np.arange(DIM) / 20)
    return rng.normal(size=(count, DIM)).astype(np.float32) * (scale / np.linalg.norm(scale)).astype(
        np.float32
    )


def drives(seed: int, number: int = 0) -> Iterator[np.ndarray]:
    """Yield the unit vectors of drives from a number on, [DRIVE DIM] each, reproducible by the seed."""
    shared = np.random.default_rng(seed)
    mean, kinds = MEAN * spectrum(shared, 1), KIND * spectrum(shared, KINDS)
    while True:
        rng = np.random.default_rng((seed, number))
        start, end = spectrum(rng, 1), spectrum(rng, 1)
        along = np.linspace(0, 1, DRIVE, dtype=np.float32)[:, None]
        vectors = mean + kinds[rng.integers(KINDS)] + ALONG * (start + along * (end - start))
        vectors += NOISE * spectrum(rng, DRIVE)
        yield vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
        number += 1


def embeddings(seed: int) -> np.ndarray:
    """Return all rows, [ROWS DIM]."""
    made = drives(seed)
    return np.concatenate([next(made) for _ in range(-(-ROWS // DRIVE))])[:ROWS]


def queries(seed: int) -> np.ndarray:
    """Return the unit vectors of the queries, [QUERIES DIM]."""
    made = drives(seed, -(-ROWS // DRIVE))
    rng = np.random.default_rng((seed, 1 << 40))
    asked = np.stack([next(made)[rng.integers(DRIVE)] for _ in range(QUERIES)])
    asked[QUERIES // 2 :] += ASIDE * spectrum(rng, 1)
    return asked / np.linalg.norm(asked, axis=-1, keepdims=True)


def nearest(vectors: np.ndarray, query: np.ndarray) -> np.ndarray:
    """Return the rows nearest to a query by exhaustive search."""
    likeness = vectors @ query
    best = np.argpartition(-likeness, TOP)[:TOP]
    return best[np.argsort(-likeness[best])]


def asked(answer: Callable[[np.ndarray], np.ndarray], seed: int, truth: np.ndarray) -> dict[str, float]:
    """Measure the time of a warm query (median and 95th percentile) and the recall of the nearest rows."""
    took_ms, found = [], []
    every = queries(seed)
    for query in every[:5]:
        answer(query)
    for query, true in zip(every, truth, strict=True):
        started = time.perf_counter()
        rows = answer(query)
        took_ms.append(1e3 * (time.perf_counter() - started))
        found.append(len(set(rows.tolist()) & set(true.tolist())) / TOP)
    half = QUERIES // 2
    return {
        "query_ms": median(took_ms),
        "query_ms_95": float(np.quantile(took_ms, 0.95)),
        "recall_images": float(np.mean(found[:half])),
        "recall_texts": float(np.mean(found[half:])),
    }


def with_numpy(seed: int) -> dict[str, float]:
    vectors = embeddings(seed)
    truth = np.stack([nearest(vectors, query) for query in queries(seed)])
    return asked(lambda query: nearest(vectors, query), seed, truth)


def with_faiss(seed: int, *, partitions: bool) -> dict[str, float]:
    if find_spec("faiss") is None:
        return {"installed": 0.0}
    import faiss

    vectors = embeddings(seed)
    truth = np.stack([nearest(vectors, query) for query in queries(seed)])
    kind = f"IVF{max(1, ROWS // PARTITION_ROWS)},SQ8,RFlat" if partitions else "Flat"
    index = faiss.index_factory(DIM, kind, faiss.METRIC_INNER_PRODUCT)
    started = time.perf_counter()
    index.train(vectors)
    index.add(vectors)
    build_s = time.perf_counter() - started
    if partitions:
        faiss.ParameterSpace().set_index_parameters(index, f"nprobe={PROBES},k_factor_rf={REFINEMENT}")
    found = asked(lambda query: index.search(query[None], TOP)[1][0], seed, truth)
    return {"installed": 1.0, "build_s": build_s, **found}


def rows_of(number: int, vectors: np.ndarray) -> tuple[Part, pa.Table]:
    """Return a drive as rows of an index."""
    log, count = f"made_train/{number:06d}", len(vectors)
    frame = np.arange(count) // 7
    known = {
        "key": [f"{log}@{500_000 * n}" for n in frame],
        "log": [log] * count,
        "folder": [f"/logs/{log}"] * count,
        "maps_dir": ["/maps"] * count,
        "frame": frame,
        "t_us": 500_000 * frame,
        "t_s": 0.5 * frame,
        "view": [f"v{n % 7}" for n in range(count)],
        "ego_speed": np.full(count, number % 20),
    }
    flat = pa.array(vectors.reshape(-1))
    vector = pa.FixedSizeListArray.from_arrays(flat, DIM)
    columns = [
        vector if field.name == "image"
        else pa.array(known[field.name], field.type) if field.name in known
        else pa.nulls(count, field.type)
        for field in row_schema(DIM)
    ]  # fmt: skip
    return Part(log, 0, int(frame[-1]), "made"), pa.Table.from_arrays(columns, schema=row_schema(DIM))


def with_lancedb(seed: int) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as folder:
        index = FrameIndex.make(f"{folder}/index", IndexSettings("made", f"made-{seed}", DIM, 0.5))
        held = []
        made, started = drives(seed), time.perf_counter()
        with IndexWriter(index) as writer:
            for number in range(-(-ROWS // DRIVE)):
                vectors = next(made)[: ROWS - number * DRIVE]
                writer.add(*rows_of(number, vectors))
                held.append(held_mib("cpu"))
        written_s = time.perf_counter() - started
        index.optimise()
        built_s = time.perf_counter() - started - written_s
        peak_gib = peak_rss_gib()
        vectors = embeddings(seed)
        truth = np.stack([nearest(vectors, query) for query in queries(seed)])
        del vectors

        def answer(query: np.ndarray) -> np.ndarray:
            rows = index.nearest(query, "image", None, ["log", "frame", "view"], TOP)
            number = np.array([int(name[-6:]) for name in rows["log"].to_pylist()])
            view = np.array([int(name[1:]) for name in rows["view"].to_pylist()])
            return number * DRIVE + rows["frame"].to_numpy() * 7 + view

        figures = asked(answer, seed, truth)
        whole = [time.perf_counter()]
        for query in queries(seed):
            find(index, Query(text="x", top=TOP), Target(query, None))
            whole.append(time.perf_counter())
        return {
            "rows": float(index.count()),
            "write_s": written_s,
            "partition_s": built_s,
            "held_mib_at_tenth": held[len(held) // 10],
            "held_mib_at_end": held[-1],
            "peak_rss_gib": peak_gib,
            "collapsed_query_ms": 1e3 * float(np.median(np.diff(whole))),
            **figures,
        }


BENCHMARK = Benchmark(
    question=f"How long does a query over {ROWS} embeddings take, and what does it miss?",
    arms={
        "lancedb": with_lancedb,
        "numpy": with_numpy,
        "faiss_flat": lambda seed: with_faiss(seed, partitions=False),
        "faiss_partitions": lambda seed: with_faiss(seed, partitions=True),
    },
    seeds=(0,),
    config={"rows": ROWS, "dim": DIM, "drive": DRIVE, "kinds": KINDS, "queries": QUERIES, "top": TOP},
)
