"""Class names of public data sets, and their categories in Foredrive."""

import functools
import re

from py123d.parser.nuscenes.utils.nuscenes_constants import NUSCENES_DETECTION_NAME_DICT
from py123d.parser.registry import BOX_DETECTION_LABEL_REGISTRY

from foredrive.data.boxes import category_of
from foredrive.data.notices import note
from foredrive.scene import Category

_MORE_NAMES = {
    Category.CAR: "van suv vansuv minivan sedan taxi pickup police_car ambulance vehicle_car_sedan jeep",
    Category.TRUCK: "lorry utility_vehicle utilityvehicle firetruck fire_truck",
    Category.BUS: "minibus coach",
    Category.TRAILER: "caravan_transporter caravantransporter",
    Category.CONSTRUCTION_VEHICLE: "construction_vehicle excavator bulldozer",
    Category.MOTORCYCLE: "motorbike motor scooter moped motorbiker",
    Category.BICYCLE: "bike cyclist cycle rider",
    Category.PEDESTRIAN: "adult child people person_sitting person_group police_officer construction_worker",
    Category.ANIMAL: "cat bird horse",
    Category.TRAFFIC_CONE: "cone trafficcone",
    Category.BARRIER: "road_barrier",
    Category.OTHER: "tram misc unknown debris static_object movable_object emergency_other",
}
"""Names of KITTI, Lyft Level 5, ONCE, A2D2, ApolloScape, BDD100K and others that py123d's labels lack. A
rider counts as the cycle, as in KITTI."""


@functools.cache
def _categories() -> dict[str, Category]:
    """Return the category of each known name, in its plain spelling."""
    labels = {
        _plain(label.name): category_of(label)
        for kind in BOX_DETECTION_LABEL_REGISTRY.values()
        for label in kind
    }
    labels |= {_plain(name): category_of(label) for name, label in NUSCENES_DETECTION_NAME_DICT.items()}
    named = {name: category for category, names in _MORE_NAMES.items() for name in names.split()}
    # Later entries win: these names are chosen by hand, and the categories' own names are fixed
    return labels | named | {category.name.lower(): category for category in Category}


def category_named(name: str) -> Category | None:
    """Return the category of a class of another data set, or None if the name is not known.

    Letter case, blanks, dots, dashes, underscores, a plural's s and a prefix TYPE_ make no difference.
    """
    plain = _plain(name)
    categories = _categories()
    spellings = (plain, plain.removeprefix("type_"), plain.removesuffix("s"))
    return next((categories[spelling] for spelling in spellings if spelling in categories), None)


def category_or_other(name: str, source: str) -> Category:
    """Return the category of a class; an unknown one is OTHER, and noted by its name."""
    category = category_named(name)
    if category is None:
        note(source, "boxes of unknown classes, read as OTHER", repr(name))
        return Category.OTHER
    return category


def _plain(name: str) -> str:
    """Return a name in lower case with single underscores between its words."""
    return re.sub(r"[\W_]+", "_", name.strip()).strip("_").lower()
