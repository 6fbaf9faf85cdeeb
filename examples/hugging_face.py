"""A trained run as a model folder of the Hugging Face hub: `python hugging_face.py RUN FOLDER`.

`load` takes the folder, or the name of a repository on the hub. Weights are safetensors, never pickles.
"""

import json
import shutil
import sys
from pathlib import Path

from huggingface_hub import snapshot_download

from foredrive.engine.folder import CONFIG, LOGS
from foredrive.files import atomic_path
from foredrive.methods.planner.agent import PlanningAgent
from foredrive.runs import Run, load_agent, open_run
from foredrive.runs.shipped import run_folder

FILES = (CONFIG, "rigs.yaml", "*/model.safetensors", "baselines*.safetensors", "tasks/*.safetensors")
"""Files of a run that a model needs: recipe, cameras, weights of each stage, baselines, heads."""
LIBRARY = "---\nlibrary_name: foredrive\npipeline_tag: robotics\n---\n\n"
"""Head of the README, by which the hub finds models."""


def save(run: Run, folder: Path, about: str) -> Path:
    """Write a folder that `hf upload OWNER/NAME FOLDER` can upload.

    Args:
        run: a run, finished or with its first stage alone.
        folder: the folder; one that exists is replaced.
        about: model card in Markdown: data, figures, limits.
    """
    with atomic_path(folder) as temporary:
        for pattern in FILES:
            for file in sorted(run.folder.glob(pattern)):
                place = temporary / file.relative_to(run.folder)
                place.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(file, place)
        (temporary / LOGS).write_text(json.dumps({"logs": [], "cache_dir": "cache"}))
        (temporary / "README.md").write_text(LIBRARY + about)
    return folder


def load(name: str, **options: object) -> tuple[Run, PlanningAgent]:
    """Return the run and the agent of a folder, or of a repository on the hub such as "you/nemo".

    Args:
        name: folder or repository.
        options: of `snapshot_download`, such as revision.
    """
    folder = Path(name) if Path(name).is_dir() else Path(snapshot_download(name, **options))
    run = open_run(folder)
    return run, load_agent(run)


if __name__ == "__main__":
    source = run_folder(Path(sys.argv[1]))
    card = source / "card.md"
    save(open_run(source), Path(sys.argv[2]), card.read_text() if card.is_file() else f"# {source.name}\n")
    print(f"wrote {sys.argv[2]}; next: hf upload OWNER/NAME {sys.argv[2]}")
