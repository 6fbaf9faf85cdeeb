"""Runs evaluations: predictions and truth in, one flat summary out."""

from typing import TYPE_CHECKING

from foredrive.lazy import on_demand

if TYPE_CHECKING:
    from foredrive.evaluation.baselines import (
        ConstantVelocity,
        DrivenStatus,
        StandStill,
        fit_ego_mlp,
        read_status,
        read_training_set,
    )
    from foredrive.evaluation.bench import Benchmark, run_benchmark
    from foredrive.evaluation.predictor import Prediction, Predictor
    from foredrive.evaluation.provenance import collect_provenance, peak_rss_gib
    from foredrive.evaluation.run import EvaluationResult, Failure, evaluate
    from foredrive.evaluation.summary import print_summary, read_summary, write_summary

__all__ = [
    "Benchmark",
    "ConstantVelocity",
    "DrivenStatus",
    "EvaluationResult",
    "Failure",
    "Prediction",
    "Predictor",
    "StandStill",
    "collect_provenance",
    "evaluate",
    "fit_ego_mlp",
    "peak_rss_gib",
    "print_summary",
    "read_status",
    "read_summary",
    "read_training_set",
    "run_benchmark",
    "write_summary",
]

__getattr__ = on_demand(
    __name__,
    {
        "baselines": (
            "ConstantVelocity",
            "DrivenStatus",
            "StandStill",
            "fit_ego_mlp",
            "read_status",
            "read_training_set",
        ),
        "bench": ("Benchmark", "run_benchmark"),
        "predictor": ("Prediction", "Predictor"),
        "provenance": ("collect_provenance", "peak_rss_gib"),
        "run": ("EvaluationResult", "Failure", "evaluate"),
        "summary": ("print_summary", "read_summary", "write_summary"),
    },
)
