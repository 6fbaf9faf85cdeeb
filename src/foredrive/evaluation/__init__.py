"""Evaluations: predictions and truth in, one flat summary out."""

from typing import TYPE_CHECKING

from foredrive.lazy import on_demand

if TYPE_CHECKING:
    from foredrive.evaluation.baselines import ConstantVelocity, StandStill
    from foredrive.evaluation.bench import Benchmark, run_benchmark
    from foredrive.evaluation.metric import EvaluationContext, Figures, Metric, MetricFactory, labels_from_now
    from foredrive.evaluation.metrics import METRICS
    from foredrive.evaluation.predictor import Part, Prediction, Predictor
    from foredrive.evaluation.provenance import collect_provenance, peak_rss_gib
    from foredrive.evaluation.run import EvaluationResult, Failure, evaluate
    from foredrive.evaluation.summary import read_summary, write_summary

__all__ = [
    "METRICS",
    "Benchmark",
    "ConstantVelocity",
    "EvaluationContext",
    "EvaluationResult",
    "Failure",
    "Figures",
    "Metric",
    "MetricFactory",
    "Part",
    "Prediction",
    "Predictor",
    "StandStill",
    "collect_provenance",
    "evaluate",
    "labels_from_now",
    "peak_rss_gib",
    "read_summary",
    "run_benchmark",
    "write_summary",
]

__getattr__ = on_demand(
    __name__,
    {
        "baselines": ("ConstantVelocity", "StandStill"),
        "bench": ("Benchmark", "run_benchmark"),
        "metric": ("EvaluationContext", "Figures", "Metric", "MetricFactory", "labels_from_now"),
        "metrics": ("METRICS",),
        "predictor": ("Part", "Prediction", "Predictor"),
        "provenance": ("collect_provenance", "peak_rss_gib"),
        "run": ("EvaluationResult", "Failure", "evaluate"),
        "summary": ("read_summary", "write_summary"),
    },
)
