"""Frames that the shipped NeMo renders: `foredrive bench nemo-images-shipped` takes ten minutes on one core.

It judges as nemo_images does, after fifty times as many steps, on the same drives. There is one model, so its
figures have no spread. Drives and the picture are kept in runs/nemo_images_shipped/COMMIT.
"""

from pathlib import Path

from benchmarks.common.benchmark import Benchmark
from benchmarks.common.study import record_study, work_folder
from benchmarks.nemo_images import TOWNS, judge
from foredrive.data import ClipDataset
from foredrive.runs.shipped import run_folder
from foredrive.runs.train.run import load_agent, open_run

WORK = work_folder(Path("runs/nemo_images_shipped"))
MODEL = "embedded:nemo_town"


def shipped(_: int) -> dict[str, float]:
    """Judge the model's frames in the test town."""
    logs = record_study(TOWNS, WORK / "towns", workers=1)
    run = open_run(run_folder(Path(MODEL), WORK))
    clips = ClipDataset(list(logs.test), run.recipe.clips, cache_dir=WORK / "cache")
    return judge(load_agent(run), clips, WORK / "pictures" / "shipped.png")


BENCHMARK = Benchmark(
    question="Do imagined frames blur, and is their motion learned, after thirty minutes of two cores?",
    arms={"nemo_town": shipped},
    config={"model": MODEL},
    seeds=(0,),
)
