"""Assets of towns: colours, façades, plants and vehicles. Assets for testing are kept separate."""

import enum
from dataclasses import dataclass, fields

from foredrive.towns.map.names import is_held_out
from foredrive.towns.place.materials import WallKind, WindowKind

Rgb = tuple[float, float, float]
Palette = tuple[Rgb, ...]


class AssetSet(enum.StrEnum):
    """The assets from which a world is made. Nothing of TEST ever appears in a world of TRAIN."""

    TRAIN = "train"
    TEST = "test"
    MIXED = "mixed"


@dataclass(frozen=True)
class Assets:
    """All assets to choose from. Colours are reflectances as sRGB would show them under white light."""

    walls: tuple[tuple[WallKind, Rgb], ...]
    """Walls of houses and blocks."""
    windows: tuple[WindowKind, ...]
    """Windows of blocks."""
    curtain: Palette
    """Colours of the frames of glass façades."""
    sheet: Palette
    """Colours of the walls of halls."""
    roofs: Palette
    flat_roofs: Palette
    awnings: Palette
    accents: tuple[int, ...]
    """Colours of doors, shutters and shop signs, as rows of `facades.ACCENT_RGB`."""
    leaves: Palette
    needles: Palette
    trees: tuple[str, ...]
    vehicles: tuple[str, ...]
    """Vehicle shapes, as names in `actor_meshes.VEHICLES`."""
    car_paints: Palette
    cargo_paints: Palette
    bus_paints: Palette
    clothes: Palette


_TRAIN = Assets(
    walls=(
        (WallKind.PLASTER, (0.80, 0.76, 0.67)),
        (WallKind.PLASTER, (0.76, 0.69, 0.58)),
        (WallKind.PLASTER, (0.82, 0.81, 0.77)),
        (WallKind.PLASTER, (0.72, 0.60, 0.50)),
        (WallKind.PLASTER, (0.80, 0.73, 0.57)),
        (WallKind.BRICK, (0.55, 0.36, 0.30)),
        (WallKind.BRICK, (0.62, 0.46, 0.37)),
        (WallKind.BRICK, (0.48, 0.33, 0.28)),
        (WallKind.STONE, (0.66, 0.65, 0.63)),
        (WallKind.STONE, (0.74, 0.72, 0.68)),
    ),
    windows=(WindowKind.CASEMENT, WindowKind.CASEMENT, WindowKind.TALL, WindowKind.RIBBON),
    curtain=((0.42, 0.50, 0.56), (0.36, 0.40, 0.44), (0.50, 0.55, 0.55)),
    sheet=((0.72, 0.73, 0.72), (0.52, 0.58, 0.64), (0.70, 0.66, 0.56), (0.45, 0.47, 0.48)),
    roofs=((0.50, 0.27, 0.20), (0.42, 0.24, 0.19), (0.34, 0.33, 0.34), (0.38, 0.30, 0.25)),
    flat_roofs=((0.46, 0.45, 0.44), (0.55, 0.53, 0.50), (0.36, 0.36, 0.37)),
    awnings=((0.55, 0.12, 0.12), (0.12, 0.32, 0.20), (0.15, 0.25, 0.45), (0.80, 0.65, 0.30)),
    accents=(0, 1, 2, 3, 4, 5),
    leaves=((0.24, 0.34, 0.12), (0.30, 0.38, 0.15), (0.19, 0.29, 0.12), (0.36, 0.40, 0.15)),
    needles=((0.14, 0.24, 0.14), (0.17, 0.27, 0.15)),
    trees=("round", "round", "tall", "conifer", "bush"),
    vehicles=(
        "sedan",
        "hatchback",
        "suv",
        "estate",
        "van",
        "pickup",
        "truck",
        "bus",
        "motorcycle",
        "bicycle",
    ),
    car_paints=(
        (0.93, 0.93, 0.93),
        (0.90, 0.90, 0.90),
        (0.08, 0.08, 0.09),
        (0.14, 0.14, 0.15),
        (0.45, 0.46, 0.48),
        (0.72, 0.73, 0.75),
        (0.60, 0.08, 0.08),
        (0.10, 0.20, 0.45),
        (0.20, 0.23, 0.26),
        (0.85, 0.84, 0.80),
        (0.12, 0.28, 0.20),
        (0.40, 0.30, 0.22),
    ),
    cargo_paints=((0.90, 0.90, 0.88), (0.75, 0.76, 0.74), (0.20, 0.35, 0.60), (0.62, 0.20, 0.16)),
    bus_paints=((0.80, 0.15, 0.12), (0.92, 0.92, 0.90), (0.15, 0.35, 0.60), (0.85, 0.70, 0.15)),
    clothes=(
        (0.15, 0.16, 0.20),
        (0.55, 0.12, 0.14),
        (0.18, 0.30, 0.52),
        (0.85, 0.83, 0.78),
        (0.30, 0.42, 0.28),
        (0.62, 0.52, 0.36),
        (0.35, 0.36, 0.38),
        (0.12, 0.12, 0.13),
    ),
)

_TEST = Assets(
    walls=(
        (WallKind.PLASTER, (0.62, 0.70, 0.74)),
        (WallKind.PLASTER, (0.86, 0.64, 0.42)),
        (WallKind.PLASTER, (0.70, 0.74, 0.62)),
        (WallKind.BRICK, (0.72, 0.66, 0.54)),
        (WallKind.BRICK, (0.36, 0.28, 0.27)),
        (WallKind.STONE, (0.55, 0.50, 0.44)),
        (WallKind.STONE, (0.78, 0.68, 0.56)),
        (WallKind.BOARDS, (0.46, 0.32, 0.22)),
        (WallKind.BOARDS, (0.70, 0.72, 0.72)),
    ),
    windows=(WindowKind.SHUTTERED, WindowKind.GRID, WindowKind.SLIT),
    curtain=((0.52, 0.44, 0.34), (0.25, 0.36, 0.34), (0.62, 0.63, 0.66)),
    sheet=((0.56, 0.38, 0.30), (0.40, 0.48, 0.40), (0.82, 0.80, 0.74)),
    roofs=((0.58, 0.40, 0.28), (0.27, 0.31, 0.33), (0.33, 0.40, 0.37)),
    flat_roofs=((0.50, 0.44, 0.38), (0.40, 0.43, 0.42)),
    awnings=((0.70, 0.36, 0.12), (0.34, 0.14, 0.36), (0.88, 0.86, 0.80)),
    accents=(6, 7, 8, 9, 10),
    leaves=((0.42, 0.30, 0.10), (0.17, 0.25, 0.16), (0.30, 0.33, 0.22)),
    needles=((0.20, 0.27, 0.25),),
    trees=("poplar", "willow", "willow", "palm", "hedge_ball"),
    vehicles=(
        "coupe",
        "compact",
        "crossover",
        "people_carrier",
        "panel_van",
        "tanker",
        "coach",
        "scooter",
        "city_bike",
    ),
    car_paints=(
        (0.97, 0.96, 0.93),
        (0.04, 0.05, 0.06),
        (0.55, 0.57, 0.60),
        (0.33, 0.34, 0.36),
        (0.82, 0.55, 0.10),
        (0.30, 0.45, 0.62),
        (0.45, 0.10, 0.18),
        (0.06, 0.34, 0.38),
        (0.66, 0.62, 0.52),
    ),
    cargo_paints=((0.84, 0.80, 0.70), (0.30, 0.42, 0.34), (0.80, 0.72, 0.30)),
    bus_paints=((0.20, 0.50, 0.35), (0.45, 0.18, 0.42), (0.88, 0.86, 0.78)),
    clothes=(
        (0.22, 0.20, 0.17),
        (0.80, 0.62, 0.20),
        (0.50, 0.32, 0.48),
        (0.28, 0.52, 0.54),
        (0.72, 0.70, 0.74),
        (0.09, 0.11, 0.16),
        (0.68, 0.34, 0.22),
    ),
)


def assets_of(chosen: AssetSet) -> Assets:
    """Return the assets of a set. MIXED has those of both sets."""
    if chosen is AssetSet.TRAIN:
        return _TRAIN
    if chosen is AssetSet.TEST:
        return _TEST
    both = {f.name: getattr(_TRAIN, f.name) + getattr(_TEST, f.name) for f in fields(Assets)}
    return Assets(**both)


def asset_set_of(town: str) -> AssetSet:
    """Return the default asset set of a town."""
    return AssetSet.TEST if is_held_out(town) else AssetSet.TRAIN
