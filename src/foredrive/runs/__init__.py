"""Train, evaluate, drive, reconstruct, search and score, into folders of results."""

from typing import TYPE_CHECKING

from foredrive.lazy import on_demand

if TYPE_CHECKING:
    from foredrive.runs.evaluate.run import ExamplePrediction, evaluate_run, predict_examples
    from foredrive.runs.train.run import Run, load_agent, open_run, train_run

__all__ = [
    "ExamplePrediction",
    "Run",
    "evaluate_run",
    "load_agent",
    "open_run",
    "predict_examples",
    "train_run",
]

__getattr__ = on_demand(
    __name__,
    {
        "evaluate.run": ("ExamplePrediction", "evaluate_run", "predict_examples"),
        "train.run": ("Run", "load_agent", "open_run", "train_run"),
    },
)
