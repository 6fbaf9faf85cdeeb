"""Cards of the models of the package: Markdown for people, which `foredrive models` reads back."""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from foredrive.errors import InputError
from foredrive.plain_yaml import read_yaml
from foredrive.runs.shipped import CARD, CONFIG, EMBEDDED, MODELS, shipped_models
from foredrive.search.embedded import CARD as TOWER_CARD
from foredrive.search.embedded import SHIPPED as TOWERS

# The form that `ModelCard.markdown` writes
_PARTS = re.compile(
    r"# (?P<name>.+?)\n\nRecipe `(?P<recipe>.+?)`, evaluated at commit `(?P<commit>.+?)`\.\n\n"
    r"\*\*Data\.\*\* (?P<data>.+?)\n\n\*\*Figures\*\* on (?P<clips>\d+) clips, (?P<failed>\d+) failed:\n\n"
    r"\|.+?\|\n\|[-|]+\|\n(?P<rows>(?:\|.+?\|\n)*)\n\*\*Limits\.\*\* (?P<limits>.+)\n",
    flags=re.DOTALL,
)
_ROW = re.compile(r"\| (.+?) \| (\S+) \| (\S+) \|")


@dataclass(frozen=True)
class ModelCard:
    """Description of a shipped model."""

    name: str
    recipe: str
    commit: str
    data: str
    """Training and test data, in one sentence."""
    clips: int
    """Number of evaluated clips, failed ones included."""
    failed: int
    figures: Mapping[str, tuple[float, float]]
    """Figures by their titles: of the run as it was trained, and of the shipped weights in 8 bits."""
    limits: str

    def markdown(self) -> str:
        """Return the card as Markdown."""
        rows = [
            f"| {title} | {trained:.3f} | {small:.3f} |" for title, (trained, small) in self.figures.items()
        ]
        parts = [
            f"# {self.name}",
            f"Recipe `{self.recipe}`, evaluated at commit `{self.commit}`.",
            f"**Data.** {self.data}",
            f"**Figures** on {self.clips} clips, {self.failed} failed:",
            "\n".join(["| | as trained | as shipped, in 8 bits |", "|---|---|---|", *rows]),
            f"**Limits.** {self.limits}",
        ]
        return "\n\n".join(parts) + "\n"


def read_card(path: Path) -> ModelCard:
    """Read a card that `ModelCard.markdown` wrote.

    Raises:
        InputError: the file is no such card.
    """
    match = _PARTS.fullmatch(path.read_text())
    if match is None:
        raise InputError(f"{path}: not a model card")
    figures = {title: (float(trained), float(small)) for title, trained, small in _ROW.findall(match["rows"])}
    texts = (match["name"], match["recipe"], match["commit"], match["data"])
    return ModelCard(*texts, int(match["clips"]), int(match["failed"]), figures, match["limits"])


@dataclass(frozen=True)
class ShippedWeights:
    """Weights that come with the package."""

    name: str
    """As `foredrive evaluate` or `foredrive search --towers` take it."""
    kind: str
    recipe: str
    commit: str | None
    data: str
    size: int
    """Size of all files, bytes."""
    card: ModelCard | None
    """None for towers, whose figures are in docs/search.md."""


def shipped_weights() -> list[ShippedWeights]:
    """Return all models of the package, and the towers of the search.

    Raises:
        InputError: a model's card cannot be read.
    """
    cards = []
    for name in shipped_models():
        card, config = read_card(MODELS / name / CARD), read_yaml(MODELS / name / CONFIG)
        if config.get("kind") == "driver":
            kind = "driver by sight"
        else:
            kind = f"{config['model']['kind']} world model, planner"
            kind += ", task heads" if config.get("tasks") else ""
        size = _size(MODELS / name)
        cards.append(
            ShippedWeights(EMBEDDED + name, kind, card.recipe, card.commit[:7], card.data, size, card)
        )
    return [*cards, _towers()]


def find_card(name: str) -> Path:
    """Return the file with the card of a model, or of the towers (JSON).

    Args:
        name: name of a model, with or without `embedded:`, or "towers".

    Raises:
        InputError: there is no such model.
    """
    name = name.removeprefix(EMBEDDED)
    if name == "towers":
        return TOWERS / TOWER_CARD
    if name not in shipped_models():
        raise InputError(f"{name}: no such model; there are {', '.join([*shipped_models(), 'towers'])}")
    return MODELS / name / CARD


def _towers() -> ShippedWeights:
    trained = json.loads((TOWERS / TOWER_CARD).read_text())["trained"]
    towns = sorted({log.split("/")[-1].split("_")[0] for log in trained["logs"]})
    data = f"{len(trained['logs'])} drives in {', '.join(towns)}: {trained['views']} views."
    kind = "towers of search: images, lidar, captions"
    return ShippedWeights("--towers embedded", kind, "search train", None, data, _size(TOWERS), None)


def _size(folder: Path) -> int:
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
