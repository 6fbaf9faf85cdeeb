"""Retrieval quality of towers in a town that they have never seen: `foredrive bench search-retrieval`.

Drives of the held-out town under four kinds of weather have the same routes and traffic. All known facts of
the views are queried (common/retrieval_quality.py). P@K counts moments of one drive that are closer than 5 s
once, and its 95 % interval is over drives. SEARCH_RETRIEVAL_TOWERS names the towers as `--towers` of
`foredrive search index` does, one for each seed, separated by ":"; by default they are the embedded towers.
"""

import functools
import os
from pathlib import Path

from benchmarks.common.benchmark import Benchmark
from benchmarks.common.retrieval_quality import GAP_S, MODALITIES, Judged, judge_naming, judge_retrieval
from foredrive.data import LogPath
from foredrive.runs.drive.recording import record_drives
from foredrive.runs.search.sector_views import gather_views
from foredrive.runs.search.towers import EMBEDDED, find_towers
from foredrive.sensors.rigs import SURROUND
from foredrive.towns.campaign import Campaign, plan_drives

TOWERS = tuple(os.environ.get("SEARCH_RETRIEVAL_TOWERS", EMBEDDED).split(":"))
WORK = Path("runs/search_retrieval")
TOWN, SEEDS, WEATHERS = "Town05", tuple(range(201, 206)), ("clear", "night", "rain", "fog")
SECONDS, RATE_HZ, CROWD = 40.0, 0.5, (40, 40)


def drives() -> list[LogPath]:
    """Return the drives; record them if they do not exist yet."""
    campaign = Campaign((TOWN,), SEEDS, WEATHERS, CROWD, CROWD, SECONDS, RATE_HZ)
    plans = plan_drives(campaign)
    done = record_drives(plans, WORK / "towns", SURROUND, workers=os.cpu_count() or 1)
    assert not done.failed, done.failed
    return [done.logs[plan] for plan in plans]


@functools.cache
def judged(seed: int) -> dict[str, dict[str, float]]:
    """Return the metrics by modality."""
    towers = find_towers(TOWERS[seed])
    logs = drives()
    views = gather_views(logs, 1 / RATE_HZ, towers.image_side_px, towers.crop, WORK)
    seen = Judged.of_logs(logs, views, towers)
    figures = judge_retrieval(seen, towers)
    for modality, named in judge_naming(seen, towers).items():
        figures[modality] |= named
    return figures


def of_modality(modality: str, seed: int) -> dict[str, float]:
    return judged(seed)[modality]


BENCHMARK = Benchmark(
    question="What share of the first 1, 10 and 100 hits is what was asked for, by modality and weather?",
    arms={modality: functools.partial(of_modality, modality) for modality in MODALITIES},
    seeds=tuple(range(len(TOWERS))),
    config={
        "towers": TOWERS,
        "town": TOWN,
        "drives": [SEEDS, WEATHERS],
        "seconds": SECONDS,
        "rate_hz": RATE_HZ,
        "gap_s": GAP_S,
    },
)
