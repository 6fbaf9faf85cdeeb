"""The models that come with the package, as tables."""

from collections.abc import Sequence

from foredrive.runs.model_card import ModelCard, ShippedWeights
from foredrive.view.table import Column, Table, simple_table

MB = 1e6


def models_table(weights: Sequence[ShippedWeights]) -> Table:
    """Return one row for each model."""
    columns = [
        Column("name", align="left"),
        Column("kind", align="left"),
        Column("recipe", align="left"),
        Column("commit", align="left"),
        Column("MB", digits=1),
    ]
    rows = [(entry.name, entry.kind, entry.recipe, entry.commit, entry.size / MB) for entry in weights]
    return simple_table(columns, rows)


def figures_table(card: ModelCard) -> Table:
    """Return the figures of a model, as trained and as shipped."""
    columns = [
        Column(f"on {card.clips} clips, {card.failed} failed", align="left"),
        Column("as trained"),
        Column("as shipped"),
    ]
    return simple_table(columns, [(title, *pair) for title, pair in card.figures.items()])
