"""`foredrive trust`."""

from pathlib import Path
from typing import Annotated

import tyro

from foredrive.cli.arguments import OptionalPath, check_number, check_out_folder, check_reconstruction
from foredrive.lazy import importing


def trust(
    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")],
    out: OptionalPath = None,
    every: Annotated[float, tyro.conf.arg(metavar="SECONDS")] = 1.0,
) -> None:
    """Predict where the images of a reconstruction are good, beside the logged way.

    Places up to 6 m to either side and headings up to 20 degrees are judged by what the log's cameras saw of
    what is visible there. A place is trusted if the expected loss of PSNR is at most 3 dB.
    docs/reconstruction.md says how often this is right.

    Args:
        run: Folder of a reconstruction.
        out: Folder of the result: trust.json, trust.png (a map from above). By default RUN/trust.
        every: Time between the judged moments of the log, s.
    """
    folder = run / "trust" if out is None else out
    check_out_folder(folder)
    check_number("--every", every, above=0)
    check_reconstruction(run)
    with importing():
        from rich.console import Console

        from foredrive.cli.progress import job_progress
        from foredrive.files import make_folder, together
        from foredrive.runs.reconstruction.reconstruction_run import open_reconstruction
        from foredrive.runs.reconstruction.trust import place_grid, trust_of, trusted_place
        from foredrive.view.table import print_table
        from foredrive.view.trust_map import trust_table, write_trust_json, write_trust_map

    opened = open_reconstruction(run)
    with job_progress("looking at what the log saw", 1) as tick:
        expects = trust_of(opened)
        tick()
    grid, places = place_grid(opened.vehicle, every), []
    with job_progress("judging places", len(grid)) as tick:
        for place in grid:
            places.append(trusted_place(expects, opened.vehicle, *place))
            tick()
    make_folder(folder)
    with together(folder):
        write_trust_json(folder / "trust.json", expects.reference_db, places)
        write_trust_map(folder / "trust.png", opened, expects.reference_db, places)
    print_table(trust_table(expects.reference_db, places), Console())
    print(f"wrote {folder / 'trust.png'}, {folder / 'trust.json'}")
