#!/usr/bin/env bash
# faiss-cpu 1.15.1: HNSW links each vector to its nearest ones, so copies link to each other alone. A recording
# in which the vehicle stands for minutes makes the frames of all other places hard to find.
#
# Seen: of 300 queries the nearest of 2,000 vectors is found for all; with 4 × 1,000 copies beside them for about
# six in ten, and a search four times as wide does not help.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check faiss-cpu==1.15.1 numpy
OMP_NUM_THREADS=1 "$folder/venv/bin/python" - <<'PY'
import faiss
import numpy as np

rng, dim = np.random.default_rng(0), 64


def unit(count):
    x = rng.standard_normal((count, dim)).astype("f4")
    return x / np.linalg.norm(x, axis=1, keepdims=True)


places, stops = unit(2000), np.repeat(unit(4), 1000, axis=0)
asked = places[:300] + 0.05 * rng.standard_normal((300, dim)).astype("f4")


def recall(vectors, search):
    exact = faiss.IndexFlatIP(dim)
    exact.add(vectors)
    graph = faiss.IndexHNSWFlat(dim, 32, faiss.METRIC_INNER_PRODUCT)
    graph.hnsw.efSearch = search
    graph.add(vectors)
    return float((graph.search(asked, 1)[1] == exact.search(asked, 1)[1]).mean())


alone, beside = recall(places, 16), [recall(np.concatenate([stops, places]), search) for search in (16, 64)]
print(faiss.__version__, f"found: {alone:.2f} without copies, {beside[0]:.2f} and {beside[1]:.2f} with them")
assert alone == 1.0
assert max(beside) < 0.8
PY
