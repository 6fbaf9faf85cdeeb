"""Effect of NeMo's self-supervised pre-training: `foredrive bench nemo-pretraining`, hours on two cores.

`nemo_town` with and without pre-training, fine-tuned on shares of the virtual egos; the runs on all of them
are those of nemo_ablation. Table 1 of the paper has no such pair: its scratch lacks auxiliary losses and
temporal attention too.
"""

import functools

from benchmarks.common.benchmark import Benchmark
from benchmarks.common.world_models import DECIDED_BY
from benchmarks.nemo_ablation import CONFIG, FULL, arm

SHARES = (1.0, 0.3, 0.1)

BENCHMARK = Benchmark(
    question="Does pre-training help NeMo to see and to plan in a town it has not seen?",
    arms={
        f"{'scratch' if from_scratch else 'pretrained'}_{100 * share:.0f}pct": functools.partial(
            arm, FULL, share=share, from_scratch=from_scratch
        )
        for share in SHARES
        for from_scratch in (False, True)
    },
    config=CONFIG,
    decided_by=DECIDED_BY,
)
