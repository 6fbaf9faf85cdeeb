"""The rows of NeMo's Tables 1 and 3 at the scale of towns: `foredrive bench nemo-ablation` takes hours.

All rows learn from the same virtual egos, and those with the same pre-training share it
(common/world_models.py). Even and odd seeds have different pre-trainings, and each seed its own fine-tuning.
The rows of Table 1 are `nemo_town_scratch`, `nemo_town_base`, `nemo_town_attention` and `nemo_town`.
"""

import dataclasses
import functools

from benchmarks.common.benchmark import Benchmark, study_identity
from benchmarks.common.world_models import DECIDED_BY, ROOT, config_of, fine_tuned, of_the_study
from foredrive.runs.recipes.known import RECIPES

FULL = "nemo_town"
TABLE_1 = (FULL, f"{FULL}_scratch", f"{FULL}_base", f"{FULL}_attention")
TABLE_3 = tuple(name for name in RECIPES if name.startswith(FULL) and name not in TABLE_1)
PRETRAININGS = 2
CONFIG = config_of(FULL) | {"pretrainings": PRETRAININGS}
IDENTITY = study_identity(CONFIG, DECIDED_BY)


def arm(name: str, seed: int, *, share: float = 1.0, from_scratch: bool = False) -> dict[str, float]:
    """Fine-tune a row on a part of the egos, evaluate it on the test drives, and return its figures.

    Args:
        name: of the recipe.
        seed: of the fine-tuning.
        share: part of the egos that fine-tuning learns from. Pre-training has them all.
        from_scratch: leave out the recipe's pre-training.
    """
    recipe = of_the_study(name, seed, pretraining_seed=seed % PRETRAININGS)
    recipe = dataclasses.replace(recipe, pretrain=None) if from_scratch else recipe
    run = f"{name}{'_from_scratch' if from_scratch else ''}_{100 * share:.0f}pct_seed{seed}"
    return fine_tuned(recipe, ROOT / "nemo_ablation" / IDENTITY / run, share=share)


BENCHMARK = Benchmark(
    question="What does each part of NeMo add, in the rows of its Tables 1 and 3?",
    arms={name: functools.partial(arm, name) for name in (*TABLE_1, *TABLE_3)},
    config=CONFIG,
    decided_by=DECIDED_BY,
)
