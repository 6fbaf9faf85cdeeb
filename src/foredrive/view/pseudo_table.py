"""The table of a pseudo-simulation: both stages, sub-score by sub-score."""

from collections.abc import Mapping

from foredrive.view.table import Column, Row, Section, Table, number

NAMES = {
    "nc": "no at-fault collision",
    "dac": "drivable area",
    "ddc": "driving direction",
    "tlc": "traffic lights",
    "ep": "progress",
    "ttc": "time to collision",
    "lk": "lane keeping",
    "hc": "history comfort",
    "ec": "extended comfort",
    "epdms": "EPDMS of the stage",
}
TRUSTED = "second.trusted_share"


def pseudo_table(summary: Mapping[str, object]) -> Table:
    """Return the means of the sub-scores of both stages, and the score over both."""
    columns = (Column(align="left"), Column("first stage", digits=3), Column("second stage", digits=3))
    rows = [
        Row([name, _value(summary, f"first.{key}"), _value(summary, f"second.{key}")])
        for key, name in NAMES.items()
    ]
    both = Row(["both stages", _value(summary, "epdms"), ""], is_strong=True)
    notes = [f"{summary['starts']} starts, {summary['failed']} failed; red lights are not known"]
    if isinstance(share := summary.get(TRUSTED), float):
        notes.append(f"{100 * share:.0f} % of the states of the second stage have trusted images")
    return Table(columns, [Section(rows), Section([both])], notes=notes)


def _value(summary: Mapping[str, object], key: str) -> str:
    value = summary[key]
    return number(value if isinstance(value, float | int) else None, 3)
