"""Pickles from outside: plain data load, anything that could run does not."""

import pickle
from pathlib import Path

import numpy as np
import pytest

from foredrive.data.safe_pickle import load_pickle
from foredrive.errors import InputError


class Intruder:
    def __reduce__(self) -> tuple:
        return print, ("run",)


@pytest.mark.parametrize("protocol", [2, 4, 5])
def test_plain_data_load(tmp_path: Path, protocol: int) -> None:
    data = {"a": [1, 2.5, "x", None, True], "n": np.float64(3.5), "array": np.arange(6.0).reshape(2, 3)}
    file = tmp_path / "plain.pkl"
    file.write_bytes(pickle.dumps(data, protocol=protocol))
    loaded = load_pickle(file)
    np.testing.assert_array_equal(loaded.pop("array"), data.pop("array"))
    assert loaded == data


def test_code_is_not_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "intruder.pkl"
    file.write_bytes(pickle.dumps({"a": Intruder()}))
    with pytest.raises(InputError, match=r"intruder\.pkl.*builtins\.print"):
        load_pickle(file)
    assert capsys.readouterr().out == ""


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    file = tmp_path / "half.pkl"
    file.write_bytes(pickle.dumps(list(range(1000)))[:50])
    with pytest.raises(InputError, match=r"half\.pkl"):
        load_pickle(file)
