"""Pickles from outside: plain data load, anything that could run does not."""

import importlib
import pickle
from pathlib import Path

import numpy as np
import pytest

from foredrive.data.safe_pickle import load_pickle, load_records
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


def test_records_of_a_schema_load_under_their_old_name(tmp_path: Path) -> None:
    """nuReasoning's files name the module `data_schema`; of its names, the dataclasses alone are allowed."""
    name = "py123d.parser.nureasoning.utils.nureasoning_schema"
    schema = importlib.import_module(name)
    state = schema.TrafficLightState(id=7, state="red")
    file = tmp_path / "annotations.pkl"
    # by name alone, as in protocol 2, in which a length is no part of the stream
    file.write_bytes(pickle.dumps(schema.Annotations([], [state]), 2).replace(name.encode(), b"data_schema"))
    loaded = load_records(file, name, {"data_schema": name})
    assert isinstance(loaded, schema.Annotations)
    assert loaded.traffic_light_states == [state]
    for asked in (b"load_schema_pickle", b"Path", b"pickle"):
        file.write_bytes(b"cdata_schema\n" + asked + b"\n.")
        with pytest.raises(InputError, match="which plain data do not need"):
            load_records(file, name, {"data_schema": name})
    file.write_bytes(pickle.dumps(Intruder()))
    with pytest.raises(InputError, match=r"builtins\.print"):
        load_records(file, name, {"data_schema": name})
