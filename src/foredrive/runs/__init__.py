"""Train, evaluate, drive, rebuild, search and score, into folders of results."""

from typing import TYPE_CHECKING

from foredrive.lazy import on_demand

if TYPE_CHECKING:
    from foredrive.runs.demo import DemoSize, full_demo, quick_demo, run_demo
    from foredrive.runs.evaluate.run import ExamplePrediction, evaluate_run, predict_examples
    from foredrive.runs.train.run import Run, load_agent, open_run, train_run

__all__ = [
    "DemoSize",
    "ExamplePrediction",
    "Run",
    "evaluate_run",
    "full_demo",
    "load_agent",
    "open_run",
    "predict_examples",
    "quick_demo",
    "run_demo",
    "train_run",
]

__getattr__ = on_demand(
    __name__,
    {
        "demo": ("DemoSize", "full_demo", "quick_demo", "run_demo"),
        "evaluate.run": ("ExamplePrediction", "evaluate_run", "predict_examples"),
        "train.run": ("Run", "load_agent", "open_run", "train_run"),
    },
)
