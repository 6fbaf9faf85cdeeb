"""Kinds of damage to files, by what a file is. Each returns the bytes of a bad file made of a good one."""

import gzip
import io
import json
import os
import pickle
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

Damage = Callable[[bytes], bytes]


class Intruder:
    """A pickle that would run a command."""

    def __reduce__(self) -> tuple:
        return os.system, ("exit 7",)


def _json(change: Callable[[Any], Any]) -> Damage:
    return lambda good: json.dumps(change(json.loads(good))).encode()


def _with_nan(value: Any) -> Any:
    """Replace the first number (depth first) by NaN."""
    done = False

    def walk(part: Any) -> Any:
        nonlocal done
        if isinstance(part, dict):
            return {key: walk(entry) for key, entry in part.items()}
        if isinstance(part, list):
            return [walk(entry) for entry in part]
        if isinstance(part, int | float) and not isinstance(part, bool) and not done:
            done = True
            return float("nan")
        return part

    return walk(value)


def _without_first(value: Any) -> Any:
    """Leave out the first entry of the outermost object, or of the first object in a list."""
    if isinstance(value, dict):
        return dict(list(value.items())[1:])
    if isinstance(value, list) and value:
        return [_without_first(value[0]), *value[1:]]
    return value


def _texts(value: Any) -> Any:
    """Replace all numbers by a word."""
    if isinstance(value, dict):
        return {key: _texts(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_texts(entry) for entry in value]
    return "many" if isinstance(value, int | float) and not isinstance(value, bool) else value


ANY: dict[str, Damage] = {
    "empty": lambda good: b"",
    "cut in half": lambda good: good[: len(good) // 2],
    "zeros": lambda good: bytes(len(good)),
    "noise": lambda good: np.random.default_rng(0).bytes(max(len(good), 64)),
    "an image": lambda good: b"\x89PNG\r\n\x1a\n" + good[:20],
}
TEXT: dict[str, Damage] = {
    "not utf-8": lambda good: b"\xff\xfe\x80" + good,
    "null bytes": lambda good: b"\0" * 8 + good,
    "html": lambda good: b"<!DOCTYPE html><html><body>404 Not Found</body></html>",
}
JSON: dict[str, Damage] = TEXT | {
    "deep lists": lambda good: b"[" * 200_000,
    "deep objects": lambda good: b'{"a":' * 200_000,
    "a number": lambda good: b"17",
    "null": lambda good: b"null",
    "a text": lambda good: b'"text"',
    "an empty object": lambda good: b"{}",
    "an entry missing": _json(_without_first),
    "not a number": _json(_with_nan),
    "texts for numbers": _json(_texts),
    "a huge integer": lambda good: b"9" * 5000,
}


def _laughing(good: bytes) -> bytes:
    """Give every entry of a YAML file 2^40 values, of which each alias repeats the one before twice."""
    lists = b", ".join([b"&z0 [x, x]", *(b"&z%d [*z%d, *z%d]" % (k + 1, k, k) for k in range(40))])
    first, *others = re.findall(rb"^[\w-]+(?=:)", good, flags=re.MULTILINE)
    return b"%s: &all [%s]\n" % (first, lists) + b"".join(b"%s: *all\n" % name for name in others)


YAML: dict[str, Damage] = TEXT | {
    "an object of Python": lambda good: b"!!python/object/apply:os.system ['exit 7']",
    "deep lists": lambda good: b"[" * 20_000,
    "a number": lambda good: b"17",
    "a list": lambda good: b"- 1\n- 2\n",
    "an unknown entry": lambda good: b"wheels_of_fire: 7\n" + good,
    "an alias without anchor": lambda good: b"a: *nowhere\n",
    "an alias of itself": lambda good: good + b"more: &a [*a]\n",
    "laughs in known entries": _laughing,
    "laughs in merged keys": lambda good: (
        b"a0: &a0 {x: 1}\n"
        + b"".join(b"a%d: &a%d {<<: [*a%d, *a%d]}\n" % (k + 1, k + 1, k, k) for k in range(40))
        + good
    ),
    "a date that is none": lambda good: good + b"more: 2001-13-45\n",
    "a huge integer": lambda good: good + b"more: " + b"9" * 5000 + b"\n",
    "an entry twice": lambda good: good + re.findall(rb"^[\w-]+:", good, flags=re.MULTILINE)[0] + b" 7\n",
    "longer than any": lambda good: good + b"#" * 2**21,
    "a billion laughs": lambda good: (
        b"a: &a [x]\n"
        + b"".join(b"%c: &%c [%s]\n" % (98 + k, 98 + k, b",".join([b"*%c" % (97 + k)] * 9)) for k in range(9))
    ),
}
XML: dict[str, Damage] = TEXT | {
    "a billion laughs": lambda good: (
        b'<?xml version="1.0"?><!DOCTYPE a [<!ENTITY e0 "ha">'
        + b"".join(b'<!ENTITY e%d "%s">' % (k + 1, b"&e%d;" % k * 10) for k in range(12))
        + b"]><a>&e12;</a>"
    ),
    "an external entity": lambda good: b'<!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/hostname">]><a>&x;</a>',
    "another root": lambda good: b"<other/>",
    "deep elements": lambda good: b"<a>" * 100_000,
}
PICKLE: dict[str, Damage] = {
    "a command": lambda good: pickle.dumps(Intruder()),
    "a command within": lambda good: pickle.dumps({"a": [1, Intruder()]}),
    "another type": lambda good: pickle.dumps("text"),
    "eval by name": lambda good: b"cbuiltins\neval\n(S'1'\ntR.",
    "an empty stack": lambda good: b".",
    "a huge frame": lambda good: b"\x80\x04\x95" + struct.pack("<Q", 2**62) + b"N.",
    "a huge text": lambda good: b"\x80\x04\x8d" + struct.pack("<Q", 2**62),
}
GZIP: dict[str, Damage] = {
    name: lambda good, make=make: gzip.compress(make(good)) for name, make in PICKLE.items()
} | {
    "gzip of nothing": lambda good: gzip.compress(b""),
    "a wrong checksum": lambda good: good[:-6] + bytes(6),
}
FLOATS: dict[str, Damage] = {
    "not whole points": lambda good: good[:-3],
}
IMAGE: dict[str, Damage] = {
    "a bomb": lambda good: _png(60_000, 60_000),
    "no pixels": lambda good: _png(0, 0),
}
NUMBERS: dict[str, Damage] = TEXT | {
    "words": lambda good: b"one two three\n",
    "too few": lambda good: b"\n".join(line.rpartition(b" ")[0] for line in good.splitlines()),
}
ARROW: dict[str, Damage] = {
    "a footer of other lengths": lambda good: good[:-10] + struct.pack("<i", 2**31 - 1) + good[-6:],
    "a negative footer": lambda good: good[:-10] + struct.pack("<i", -1) + good[-6:],
    "no footer": lambda good: good[:-40],
    "a cut start": lambda good: good[64:],
}


def _png(width: int, height: int) -> bytes:
    """The header of a PNG of a size, without its pixels."""
    import zlib

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")
    )


def npy(array: np.ndarray, *, pickled: bool = False) -> bytes:
    """The bytes of an array's file."""
    out = io.BytesIO()
    np.save(out, array, allow_pickle=pickled)
    return out.getvalue()


KINDS: dict[str, dict[str, Damage]] = {
    ".json": JSON,
    ".yaml": YAML,
    ".xml": XML,
    ".pkl": PICKLE,
    ".gz": GZIP,
    ".bin": FLOATS,
    ".png": IMAGE,
    ".jpg": IMAGE,
    ".txt": NUMBERS,
    ".arrow": ARROW,
    ".feather": ARROW,
    ".bag": {},
    ".mcap": {},
}


def damages(file: Path) -> dict[str, Damage]:
    """All kinds of damage to a file, by its name."""
    return ANY | KINDS[file.suffix]
