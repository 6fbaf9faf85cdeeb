"""The device on which a process computes: `--device`, or a GPU if there is one.

Workers learn of `--device` from the environment, as of `--verbose`.
"""

import multiprocessing
import os
import re
from collections.abc import Sequence

from foredrive.errors import InputError

DEVICE = "FOREDRIVE_DEVICE"
"""Environment variable with the device of a command."""


def take_device(args: Sequence[str]) -> list[str]:
    """Take `--device DEVICE` out of a command's arguments, into the environment.

    Raises:
        InputError: it is neither cpu, cuda nor cuda:N.
    """
    os.environ.pop(DEVICE, None)  # Left by an earlier command in this process
    rest: list[str] = []
    words = iter(args)
    for word in words:
        flag, equals, value = word.partition("=")
        if flag != "--device":
            rest.append(word)
            continue
        asked = value if equals else next(words, "")
        if not re.fullmatch(r"cpu|cuda(:\d+)?", asked):
            raise InputError(f"--device takes cpu, cuda or cuda:N, not {asked!r}")
        os.environ[DEVICE] = asked
    return rest


def chosen_device() -> str:
    """Return the device of this process.

    It is that of `--device`. Without one it is a GPU, if there is one. Several workers take several GPUs in
    turn.

    Raises:
        InputError: the GPU that was asked for is not here.
    """
    import torch  # Slow to import

    cards = torch.cuda.device_count() if torch.cuda.is_available() else 0
    asked = os.environ.get(DEVICE)
    if asked is None:
        return f"cuda:{_worker() % cards}" if cards > 1 else "cuda" if cards else "cpu"
    kind, _, number = asked.partition(":")
    if kind == "cuda" and int(number or 0) >= cards:
        raise InputError(f"--device {asked}: this machine has {cards} GPUs that PyTorch can use")
    return asked


def _worker() -> int:
    """Return the number of this worker process among those of its parent; 0 in a command's own process."""
    number = multiprocessing.current_process().name.rpartition("-")[2]
    return int(number) - 1 if number.isdigit() else 0
