"""Zero-shot classification and lidar-to-image retrieval in a town that towers have never seen.

`foredrive bench search-zero-shot` indexes the drives of `search-retrieval` and evaluates the index as
`foredrive search evaluate` does. Intervals are over drives. SEARCH_ZERO_SHOT_TOWERS names the towers; by
default they are the embedded ones.
"""

import os

from benchmarks.common.benchmark import Benchmark
from benchmarks.search_retrieval import CROWD, RATE_HZ, SECONDS, SEEDS, TOWN, WEATHERS, WORK, drives
from foredrive.runs.search.evaluating import evaluate_index
from foredrive.runs.search.indexing import index_logs
from foredrive.runs.search.towers import EMBEDDED, find_towers
from foredrive.search.index import FrameIndex

TOWERS = os.environ.get("SEARCH_ZERO_SHOT_TOWERS", EMBEDDED)
MOMENTS = 400
"""Maximum number of moments whose objects are classified; the drives have as many."""


def evaluate(_: int) -> dict[str, float]:
    towers = find_towers(TOWERS)
    place = str(WORK / f"index-{towers.fingerprint}")
    done = index_logs(drives(), place, TOWERS, 1 / RATE_HZ, workers=1)
    assert not done.failed, done.failed
    index = FrameIndex(place)
    figures = {"rows": float(index.count())}
    for name, share in evaluate_index(index, towers, MOMENTS).items():
        figures[name] = share.value
        if share.low is not None and share.high is not None:
            figures |= {f"{name}_low": share.low, f"{name}_high": share.high}
    return figures


BENCHMARK = Benchmark(
    question="What do towers name rightly without training for it, and do sweeps find their images?",
    arms={"towers": evaluate},
    seeds=(0,),
    config={
        "towers": TOWERS,
        "town": TOWN,
        "drives": [SEEDS, WEATHERS],
        "crowd": CROWD,
        "seconds": SECONDS,
        "rate_hz": RATE_HZ,
        "moments": MOMENTS,
    },
)
