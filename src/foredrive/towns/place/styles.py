"""Styles of towns: the kinds and the density of buildings, and the objects along the roads."""

from dataclasses import dataclass

from foredrive.towns.map.names import town_of


@dataclass(frozen=True)
class Style:
    """The character of a town."""

    kinds: tuple[tuple[str, float], ...]
    """Shares of "house", "block", "tower", "hall" and "barn"."""
    storeys: tuple[int, int]
    """Minimum and maximum number of storeys of blocks."""
    density: float
    """Share of the frontage along walkways that is built on."""
    open_density: float
    """The same along roads without walkways."""
    skyline: float
    """Share of the free spots behind the first row that are built on."""
    shops: float
    """Share of blocks with shops on the ground floor."""
    power_lines: float
    """Share of the roads with wires on poles beside them, instead of street lamps."""
    billboards: float
    """Number of billboards per kilometre of road."""
    farmland: bool = False
    """Whether the land between the roads has fields."""


_SMALL = (("house", 0.55), ("block", 0.45))
_SUBURB = (("house", 0.20), ("block", 0.42), ("hall", 0.26), ("tower", 0.12))
_OUTSKIRTS = (("house", 0.32), ("block", 0.28), ("hall", 0.36), ("tower", 0.04))
_STYLES = {
    "Town01": Style(_SMALL, (2, 4), 0.75, 0.3, 0.25, 0.35, 0.3, 0.3),
    "Town02": Style((("house", 0.4), ("block", 0.6)), (2, 5), 0.85, 0.3, 0.30, 0.4, 0.3, 0.3),
    "Town03": Style(_SUBURB, (3, 7), 0.75, 0.3, 0.32, 0.45, 0.1, 1.0),
    "Town04": Style(_OUTSKIRTS, (2, 5), 0.70, 0.14, 0.10, 0.35, 0.15, 1.0),
    "Town05": Style((("block", 0.78), ("tower", 0.22)), (3, 8), 0.80, 0.15, 0.35, 0.7, 0.0, 1.2),
    "Town06": Style(_OUTSKIRTS, (1, 4), 0.60, 0.22, 0.10, 0.3, 0.2, 1.2),
    "Town07": Style((("house", 0.66), ("barn", 0.34)), (1, 2), 0.50, 0.20, 0.07, 0.2, 0.7, 0.1, True),
    "Town10HD": Style((("block", 0.6), ("tower", 0.4)), (4, 10), 0.90, 0.3, 0.50, 0.8, 0.0, 1.0),
    "Town11": Style(_OUTSKIRTS, (2, 5), 0.60, 0.10, 0.10, 0.3, 0.2, 0.8),
    "Town12": Style(_SUBURB, (3, 9), 0.80, 0.25, 0.35, 0.5, 0.1, 0.8),
    "Town13": Style(
        (("house", 0.42), ("block", 0.40), ("hall", 0.18)), (2, 6), 0.75, 0.22, 0.25, 0.4, 0.2, 0.8
    ),
    "Town15": Style(
        (("block", 0.62), ("hall", 0.26), ("house", 0.12)), (2, 5), 0.65, 0.25, 0.25, 0.3, 0.0, 0.5
    ),
}


def style_of(town: str) -> Style:
    """Return the style of a town or of a tile. Maps of one's own are suburbs, as Town03."""
    return _STYLES.get(town_of(town), _STYLES["Town03"])
