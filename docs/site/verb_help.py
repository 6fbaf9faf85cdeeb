"""The page with what `foredrive VERB --help` prints, for all verbs."""

import json
import os
import subprocess
import sys
import textwrap
from pathlib import Path

LIST = "import json; from foredrive.cli.main import VERBS; print(json.dumps(list(VERBS)))"
ABOUT = """# All verbs

What `foredrive VERB --help` prints, at the commit of this site. `foredrive --version` prints the version.
Wrong input ends with one line on stderr and exit code 2, Ctrl-C with exit code 130.
"""
COLUMNS = 96


def verb_page(root: Path) -> str:
    """Return the Markdown of the page."""
    verbs = json.loads(_python(root, "-c", LIST))
    helps = {verb: _wrapped(_python(root, "-m", "foredrive", *verb.split(), "--help")) for verb in verbs}
    return (
        "\n\n".join([ABOUT, *(f"## {verb}\n\n```text\n{text}\n```" for verb, text in helps.items())]) + "\n"
    )


def _python(root: Path, *args: str) -> str:
    environment = os.environ | {"PYTHONPATH": str(root / "src"), "COLUMNS": str(COLUMNS), "NO_COLOR": "1"}
    return subprocess.run(
        [sys.executable, *args], env=environment, check=True, capture_output=True, text=True
    ).stdout


def _wrapped(text: str) -> str:
    """Return a text whose paragraphs are as wide as its boxes."""
    return "\n".join(textwrap.fill(line, COLUMNS) for line in text.strip().splitlines())
