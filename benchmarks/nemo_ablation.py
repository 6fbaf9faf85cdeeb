"""The rows of NeMo's Tables 1 and 3 at the scale of towns: `foredrive bench nemo-ablation` takes hours.

Rows with the same pre-training share it (common/fine_tuning.py). The rows of Table 1 are `nemo_town_scratch`,
`nemo_town_base`, `nemo_town_attention` and `nemo_town`.
"""

import functools

from benchmarks.common.fine_tuning import CONFIG, DECIDED_BY, fine_tuned
from foredrive.engine.bench import Benchmark
from foredrive.runs.recipes.known import RECIPES

TABLE_1 = ("nemo_town", "nemo_town_scratch", "nemo_town_base", "nemo_town_attention")
TABLE_3 = tuple(name for name in RECIPES if name.startswith("nemo_town") and name not in TABLE_1)

BENCHMARK = Benchmark(
    question="What does each part of NeMo add, in the rows of its Tables 1 and 3?",
    arms={name: functools.partial(fine_tuned, name) for name in (*TABLE_1, *TABLE_3)},
    config=CONFIG,
    decided_by=DECIDED_BY,
)
