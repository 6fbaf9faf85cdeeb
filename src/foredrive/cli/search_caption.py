"""`foredrive search caption` and `search train-captions`."""

from pathlib import Path
from typing import Annotated

import tyro

from foredrive.cli.arguments import SomePaths, check_number, check_out_folder
from foredrive.cli.search import INDEX
from foredrive.cli.search_options import Name, Place, check_index
from foredrive.data.log_paths import find_all_logs
from foredrive.lazy import importing


def search_caption(
    moment: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="LOG@12.5s")],
    index: Place = INDEX,
    towers: Name = None,
) -> None:
    """Describe what the views of a moment show: from their images, and from lidar alone.

    Args:
        moment: A moment (LOG@12.5s), one view of it (LOG@12.5s/VIEW) or a part of a view
            (LOG@12.5s/VIEW:LEFT,TOP,RIGHT,BOTTOM in px); LOG is the name of an indexed log or a log's folder.
        index: The index that contains the log's name; by default its towers are used.
        towers: The folder of other towers with a trained caption decoder; LOG must be a folder then.
    """
    if towers is None:
        check_index(index)

    with importing():
        from rich.console import Console

        from foredrive.runs.search.captioning import CAPTIONS, caption_views, load_captions
        from foredrive.runs.search.towers import find_towers
        from foredrive.search.index import FrameIndex
        from foredrive.search.query import parse_like
        from foredrive.search.target import example_views
        from foredrive.view.table import Column, print_table, simple_table

    like = parse_like(moment)
    opened = FrameIndex(index) if towers is None else None
    chosen = find_towers(towers if opened is None else opened.settings.towers)
    decoder = load_captions(Path(chosen.name) / CAPTIONS, chosen)
    views, _ = example_views(opened, like, chosen)
    said = caption_views(views, chosen, decoder)
    rows = [(name, caption.by_image or None, caption.by_lidar or None) for name, caption in said.items()]
    columns = [Column(title, align="left") for title in ("view", "by image", "by lidar")]
    print_table(simple_table(columns, rows), Console())


def search_train_captions(
    logs: SomePaths, towers: Path, out: Path, stride: float = 0.5, epochs: int = 20, seed: int = 0
) -> None:
    """Train a caption decoder for towers, or continue an interrupted run.

    A small decoder learns captions of the known facts of views from the views' image embeddings. The
    embeddings of sweeps lie in the same space, so that the decoder reads them too. It is saved in the towers'
    folder.

    Args:
        logs: 123D logs, splits or data roots with cameras, and with boxes or captions.
        towers: A folder of towers that `foredrive search train` made.
        out: Folder of the run.
        stride: Time between the moments that are used, s.
        epochs: Number of passes over the data.
        seed: Seed of the weights and of the order of the data.
    """
    check_number("--stride", stride, above=0)
    check_number("--epochs", epochs, low=1)
    check_number("--seed", seed, low=0)
    check_out_folder(out)
    log_paths = find_all_logs(logs)

    with importing():
        from foredrive.engine.loop import Schedule
        from foredrive.runs.search.captioning import train_captions

    schedule = Schedule(batch_size=64, lr=1e-3, epochs=epochs, weight_decay=0.01, warmup_steps=50, seed=seed)
    print(f"wrote {train_captions(log_paths, towers, out, schedule, stride)}")
