"""Classes and prompt templates of zero-shot classification, as in LidarCLIP (Hess et al. 2024)."""

from foredrive.scene import Category

_ARTICLES = ("a", "the")
_LOOKS = ("bad", "cropped", "bright", "dark", "close-up", "black and white", "pixelated", "jpeg corrupted")
_MEDIA = ("sculpture", "rendering", "tattoo", "drawing", "painting", "doodle", "sketch", "rendition")
_KINDS = ("hard to see", "clean", "dirty", "cool", "nice", "weird", "small", "large")
_OF = (
    *(f"a {look} photo" for look in (*_LOOKS, "blurry", "good", "low resolution")),
    *(f"a {medium}" for medium in _MEDIA),
    *("graffiti", "art", "itap", "a photo"),
)
_MADE = (
    "embroidered {}",
    "plastic {}",
    "origami {}",
    "cartoon {}",
    "toy {}",
    "plushie {}",
    "{} in a video game",
)
OBJECT_TEMPLATES = (
    *(f"{of} of {article} {{}}." for of in _OF for article in _ARTICLES),
    *(f"a photo of {article} {kind} {{}}." for kind in _KINDS for article in _ARTICLES),
    *(f"{article} {made}." for made in _MADE for article in _ARTICLES),
    *(f"{of} {{}}." for of in ("a photo of many", "a photo of my", "a photo of one", "itap of my")),
    *(f"there is {article} {{}} in the scene." for article in _ARTICLES),
    *(f"this is {article} {{}} in the scene." for article in (*_ARTICLES, "one")),
)
"""The 80 templates of CLIP for ImageNet (Radford et al. 2021) and five about a scene (Gu et al. 2022)."""

_QUALITIES = ("bad", "good", "clean", "dirty", "cropped", "close-up")
_SCENES = ("environment", "scene", "road", "street", "intersection")
_TAKEN = ("taken", "captured")
WEATHER_TEMPLATES = tuple(
    f"a {quality} photo {rest}."
    for quality in _QUALITIES
    for rest in (
        *(f"of a {{}} {scene}" for scene in _SCENES),
        *(f"of many things in a {{}} {scene}" for scene in _SCENES),
        *(f"{taken} in a {{}} {scene}" for taken in _TAKEN for scene in _SCENES),
        *(f"{taken} on a {{}} day" for taken in _TAKEN),
    )
)
PERIOD_TEMPLATES = tuple(
    f"a {quality} photo {shown}{taken} at {{}}."
    for quality in _QUALITIES
    for taken in _TAKEN
    for shown in (
        "",
        *(f"of {thing} {scene} " for thing in ("a", "the", "many things in a") for scene in _SCENES),
    )
)

OBJECTS = {
    Category.CAR: "car",
    Category.TRUCK: "truck",
    Category.BUS: "bus",
    Category.PEDESTRIAN: "pedestrian",
    Category.BICYCLE: "cyclist",
}
"""Words of the classes of objects, those of ONCE."""
WEATHERS = {"clear": "sunny", "cloudy": "cloudy", "overcast": "overcast", "rain": "rainy", "fog": "foggy"}
"""Words of the weather by the value of the column `weather`. It is asked by day."""
PERIODS = {"morning": "day", "midday": "day", "afternoon": "day", "night": "night"}
"""Words of the period by the value of the column `time_of_day`. Dawn and dusk are neither."""
