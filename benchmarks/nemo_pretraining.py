"""Effect of NeMo's self-supervised pre-training: `foredrive bench nemo-pretraining`, hours on two cores.

`nemo_town` with and without pre-training, fine-tuned on shares of the drives (common/fine_tuning.py). Table 1
of the paper has no such pair: its scratch lacks auxiliary losses and temporal attention too (nemo_ablation).
"""

import functools

from benchmarks.common.fine_tuning import CONFIG, DECIDED_BY, PRETRAINED, fine_tuned
from foredrive.engine.bench import Benchmark

SHARES = (1.0, 0.3, 0.1)

BENCHMARK = Benchmark(
    question="Does pre-training help NeMo to see and to plan in a town it has not seen?",
    arms={
        f"{'pretrained' if pretrained else 'scratch'}_{100 * share:.0f}pct": functools.partial(
            fine_tuned, PRETRAINED, pretrained=pretrained, share=share
        )
        for share in SHARES
        for pretrained in (True, False)
    },
    config=CONFIG,
    decided_by=DECIDED_BY,
)
