"""Ctrl-C that hits where exceptions are dropped ends the program, and disturbs no clearing up."""

import subprocess
import sys

import pytest

PROGRAM = """
import enum, os, signal, sys, time
import numpy as np
from foredrive.cli import main as program

def press():
    os.kill(os.getpid(), signal.SIGINT)
    for _ in range(3):  # Python looks for signals where it goes back in a loop
        pass

class Pressing(enum.EnumType):
    def __getattr__(cls, name):
        if name == "__array_ufunc__":
            press()
        raise AttributeError(name)

class Kind(enum.IntEnum, metaclass=Pressing):
    CAR = 1

class Dies:
    def __del__(self):
        press()

def compare_members():
    assert (np.ones(3, dtype=np.int64) == Kind.CAR).all()
    print("went on", flush=True)
    time.sleep(60)

def delete():
    Dies()
    print("went on", flush=True)
    time.sleep(60)

def make_another_error():
    try:
        press()
    except KeyboardInterrupt:
        raise RuntimeError("something else")

def clear_up():
    try:
        press()
    finally:
        time.sleep(1.0)
        print("cleared up", flush=True)

program.VERBS = {f.__name__: f for f in (compare_members, delete, make_another_error, clear_up)}
sys.exit(program.main(sys.argv[1:]))
"""


@pytest.mark.parametrize(
    ("verb", "said"),
    [
        ("compare_members", "went on\n"),
        ("delete", "went on\n"),
        ("make_another_error", ""),
        ("clear_up", "cleared up\n"),
    ],
)
def test_an_interruption_ends_the_program_wherever_it_hits(verb: str, said: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, verb], capture_output=True, text=True, timeout=50, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, said, "foredrive: interrupted\n")
