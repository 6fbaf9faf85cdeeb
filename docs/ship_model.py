"""Make an evaluated run part of the package: `python docs/ship_model.py RUN NAME --test LOGS ...`."""

from pathlib import Path

import tyro

from foredrive.data import find_all_logs
from foredrive.runs import open_run
from foredrive.runs.ship import ship


def main(
    run: tyro.conf.Positional[Path], name: tyro.conf.Positional[str], test: list[Path], data: str, limits: str
) -> None:
    """Write src/foredrive/runs/models/NAME.

    Args:
        run: run folder.
        name: name of the model.
        test: logs of the evaluation whose figures the card shows.
        data: the training and test data, in one sentence.
        limits: what the model cannot do.
    """
    print(ship(open_run(run), name, find_all_logs(test), data, limits))


if __name__ == "__main__":
    tyro.cli(main)
