"""Kinds of arguments that several verbs take."""

from pathlib import Path
from typing import Annotated

import tyro

OptionalPath = Annotated[Path | None, tyro.conf.arg(metavar="PATH")]
SomePaths = Annotated[tuple[Path, ...], tyro.conf.arg(metavar="PATH [PATH ...]")]
Settings = Annotated[tuple[str, ...], tyro.conf.arg(metavar="KEY=VALUE [KEY=VALUE ...]")]
