"""Trained models that come with the package: `embedded:NAME` in place of a run folder."""

import json
import shutil
from pathlib import Path

from foredrive.errors import InputError
from foredrive.files import atomic_path, digest_of

EMBEDDED = "embedded:"
DRIVER = "driver"
"""Name of the model that the agent `embedded` uses."""
CONFIG, LOGS, WEIGHTS = "config.yaml", "logs.json", "model.safetensors"
"""As in `engine.folder`, which is slow to import. Arguments are checked before slow imports."""
MODELS = Path(__file__).parent / "models"
"""A folder for each model: config.yaml, logs.json without logs, the baselines, weights of the last stage in
8 bits (`save_small`), and card.md."""
CARD = "card.md"
COPIES = Path("runs")
"""Folder of the copies, below the working directory."""


def shipped_models() -> list[str]:
    """Return the names of all models that come with the package."""
    return sorted(folder.name for folder in MODELS.glob("*") if (folder / CONFIG).is_file())


def run_folder(run: Path, copies: Path = COPIES) -> Path:
    """Return the folder of a run.

    A model that comes with the package is first copied to `copies`/embedded_NAME, where evaluations and
    caches may then write. A copy that is there already is used as it is.

    Args:
        run: a run folder, `embedded:NAME`, or `embedded` for the model that drives best (`DRIVER`).
        copies: folder of the copies.

    Raises:
        InputError: there is no such model, or the copy is of another version.
    """
    if str(run) == EMBEDDED.rstrip(":"):
        if DRIVER not in shipped_models():
            raise InputError(f"this version comes without a driver; there are {', '.join(shipped_models())}")
        run = Path(EMBEDDED + DRIVER)
    if not str(run).startswith(EMBEDDED):
        return run
    name = str(run).removeprefix(EMBEDDED)
    if name not in shipped_models():
        raise InputError(f"{run}: no such model; there are {', '.join(shipped_models()) or 'none'}")
    source, copy = MODELS / name, copies / f"embedded_{name}"
    if copy.exists():
        if run_digest(source) != run_digest(copy):
            raise InputError(f"{copy}: not a copy of this version of {run}; move it away")
    else:
        with atomic_path(copy) as temporary:
            shutil.copytree(source, temporary)
            logs = temporary / LOGS
            # Caches go into the copy, because the folder of the package may not be writable
            entries = json.loads(logs.read_text()) | {"cache_dir": str((copy / "cache").absolute())}
            logs.write_text(json.dumps(entries, indent=1))
    return copy


def run_digest(folder: Path) -> str | None:
    """Return a digest of the recipe and of all weights of a run; None if the folder holds no run."""
    files = run_files(folder)
    return digest_of(files) if files else None


def run_files(folder: Path) -> list[Path]:
    """Return the files of the recipe and of all weights of a run, in a fixed order; none if it is no run."""
    if not (folder / CONFIG).is_file():
        return []
    return [folder / CONFIG, *sorted(folder.glob("*.safetensors")), *sorted(folder.glob(f"*/{WEIGHTS}"))]
