"""`foredrive search evaluate`."""

from typing import TYPE_CHECKING

from foredrive.cli.arguments import OptionalPath, check_number
from foredrive.cli.search import INDEX
from foredrive.cli.search_options import Name, Place, check_index
from foredrive.lazy import importing

if TYPE_CHECKING:
    from foredrive.runs.search.evaluating import Share


def search_evaluate(
    index: Place = INDEX, towers: Name = None, moments: int = 200, out: OptionalPath = None
) -> None:
    """Evaluate the towers of an index: zero-shot classification, and retrieval between images and sweeps.

    Objects, weather and time of day are classified with CLIP's and LidarCLIP's prompts, without training for
    it. Images retrieve the sweeps of the same moments, and sweeps the images. Intervals are over logs.

    Args:
        index: The index: a folder, or a location in object storage.
        towers: Current folder of the towers that made the index, if they have moved.
        moments: Maximum number of moments whose annotated objects are read from the logs; 0: no objects.
        out: JSON file for the figures.
    """
    check_number("--moments", moments, low=0)
    check_index(index)

    with importing():
        from foredrive.engine.summary import write_json
        from foredrive.runs.search.evaluating import evaluate_index
        from foredrive.runs.search.towers import find_towers
        from foredrive.search.index import FrameIndex

    opened = FrameIndex(index)
    shares = evaluate_index(opened, find_towers(towers or opened.settings.towers), moments)
    for arms in (("image", "lidar", "joint", "chance"), ("lidar_to_image", "image_to_lidar", "chance")):
        _print_shares(shares, arms)
    if out is not None:
        write_json(out, {name: share._asdict() for name, share in shares.items()})
        print(f"wrote {out}")


def _print_shares(shares: "dict[str, Share]", arms: tuple[str, ...]) -> None:
    from rich.console import Console

    from foredrive.view.table import MISSING, Column, number, print_table, simple_table, words

    def shown(name: str) -> str:
        share = shares.get(name)
        if share is None:
            return MISSING
        bounds = "" if share.low is None else f" [{number(share.low, 2)}, {number(share.high, 2)}]"
        return f"{number(share.value, 2)}{bounds}"

    measured = [name.removesuffix(f".{arms[0]}") for name in shares if name.endswith(f".{arms[0]}")]
    if measured:
        rows = [
            (words(name.replace(".", ": ")), *(shown(f"{name}.{arm}") for arm in arms)) for name in measured
        ]
        columns = [Column(align="left"), *(Column(words(arm)) for arm in arms)]
        print_table(simple_table(columns, rows), Console())
