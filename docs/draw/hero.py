"""Draws docs/hero.png, what the shipped NeMo sees: `python docs/draw/hero.py LOG INDEX`.

INDEX counts COUNT clips that are spread evenly over the log. The picture is of Town05_seed6 of the drives of
`foredrive bench learning`, clip 25.
"""

import sys
import tempfile
from pathlib import Path

from foredrive.data import find_logs
from foredrive.runs import open_run, predict_examples
from foredrive.runs.shipped import run_folder
from foredrive.view.overview import Overview, write_overview

DOCS = Path(__file__).parents[1]
COUNT = 40


def main() -> None:
    """Draw the clip that is named."""
    log, index = sys.argv[1:]
    with tempfile.TemporaryDirectory() as folder:
        run = open_run(run_folder(Path("embedded:nemo_town"), Path(folder)))
        shown = predict_examples(run, find_logs(Path(log)), COUNT)
        write_overview(DOCS / "hero.png", Overview.of(shown[int(index)]))


if __name__ == "__main__":
    main()
