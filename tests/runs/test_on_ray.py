"""Jobs on a Ray cluster of two workers: a killed worker loses nothing; the bytes are those of one process."""

import os
import signal
import sys
import threading
import time
from pathlib import Path

import pytest
from file_digests import digests

from benchmarks.common.process_tree import descendants
from foredrive.data import LogPath
from foredrive.engine.fan_out import fan_out
from foredrive.runs import Run, evaluate_run
from foredrive.runs.drive.recording import record_drives, record_plan
from foredrive.sensors.rigs import SURROUND
from foredrive.towns.campaign import DrivePlan

RIG = SURROUND.of_size((36, 64))
PLANS = [DrivePlan("Town02", seed, None, 6, 4, 1.0, 2.0) for seed in range(1, 5)]
LOST = DrivePlan("Town99", 1, None, 6, 4, 1.0, 2.0)


class Killer(threading.Thread):
    """Kills one of Ray's workers while it records.

    It waits for the first finished log, so that the worker has the job of a drive and not of an import.
    """

    def __init__(self, logs: Path) -> None:
        super().__init__(daemon=True)
        self.killed: int | None = None
        self.others: set[str] = set()
        """Logs that were there when the worker was killed."""
        self._logs = logs

    def run(self) -> None:
        for _ in range(6000):
            whole = set(self._logs.glob("*/sync.arrow"))
            if whole and (busy := [pid for pid in descendants(os.getpid()) if is_at_work(pid)]):
                os.kill(busy[0], signal.SIGKILL)
                self.killed, self.others = busy[0], {file.parent.name for file in whole}
                return
            time.sleep(0.01)


def is_at_work(pid: int) -> bool:
    """Return whether a process is a worker of Ray with a task; Ray writes its task into its command line."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().startswith(b"ray::_quietly")
    except OSError:
        return False


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::ResourceWarning")  # Ray leaves its own processes to the system
def test_a_killed_worker_loses_nothing(tmp_path: Path) -> None:
    logs = tmp_path / "ray" / "logs" / "town_train"
    killer = Killer(logs)
    killer.start()
    on_ray = record_drives([LOST, *PLANS], tmp_path / "ray", RIG, workers=2, on_ray=True)
    assert killer.killed is not None
    assert len(killer.others) < len(PLANS)
    assert list(on_ray.logs) == PLANS
    assert list(on_ray.failed) == [LOST]
    assert "unknown town 'Town99'" in on_ray.failed[LOST]
    for plan in PLANS:
        record_plan(plan, tmp_path / "alone", RIG, threads=1)
    assert digests(tmp_path / "ray") == digests(tmp_path / "alone")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_an_evaluation_has_the_figures_of_one_process(trained: Run, log: LogPath, tmp_path: Path) -> None:
    on_ray = evaluate_run(trained, [log], tmp_path / "ray", batch_size=1, workers=2, on_ray=True)
    alone = evaluate_run(trained, [log], tmp_path / "alone", batch_size=1)
    for key, value in alone.summary.items():
        if isinstance(value, float) and key not in ("wall_s", "peak_rss_gib"):
            assert on_ray.summary[key] == pytest.approx(value, rel=1e-6, nan_ok=True), key


def cards_of_job(number: int) -> str:
    """Return the GPUs that Ray shows to a job, after others had time to begin."""
    time.sleep(0.3)
    return os.environ.get("CUDA_VISIBLE_DEVICES", "")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_a_job_has_a_card_of_its_own() -> None:
    """A cluster of four cores that says it has two GPUs; no job looks for them."""
    import ray

    paths = {"PYTHONPATH": os.pathsep.join(sys.path)}  # Workers import this file
    ray.init(
        num_cpus=4,
        num_gpus=2,
        include_dashboard=False,
        log_to_driver=False,
        runtime_env={"env_vars": paths},
    )
    try:
        cards = [card for _, card in fan_out(range(6), cards_of_job, 4, on_ray=True, on_gpu=True)]
        assert set(cards) == {"0", "1"}
        without = [card for _, card in fan_out(range(2), cards_of_job, 4, on_ray=True)]
        assert set(without) == {""}
    finally:
        ray.shutdown()
