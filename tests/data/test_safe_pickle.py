"""Pickles from outside: plain data load, anything that could run does not."""

import gzip
import importlib
import io
import pickle
import resource
import sys
import types
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from foredrive.data.safe_pickle import MAX_UNZIPPED_BYTES, load_pickle, load_records, load_table
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


def call(name: str, *args: bytes) -> bytes:
    """A pickle of a call; the arguments are opcodes."""
    return b"c" + name.replace(" ", "\n").encode() + b"\n(" + b"".join(args) + b"tR"


def number(value: int) -> bytes:
    return b"L%dL\n" % value


HUGE = number(10**10)
LONG_TYPE = call("numpy dtype", b"S'V2000000000'\n")
RANGE = call(
    "pandas.core.indexes.base _new_Index",
    b"cpandas\nRangeIndex\n",
    b"(S'start'\n" + number(0) + b"S'stop'\n" + HUGE + b"S'step'\n" + number(1) + b"d",
)
ENCODED = b"S'ab'\n"
for _ in range(34):  # each hexadecimal text is twice as long
    ENCODED = call("_codecs encode", ENCODED, b"S'hex'\n")


@pytest.mark.parametrize(
    "made",
    [
        call("numpy ndarray", b"(" + HUGE + b"t"),
        call("numpy._core.multiarray _reconstruct", b"cnumpy\nndarray\n", b"(" + HUGE + b"t", b"S'b'\n"),
        call("numpy._core.multiarray scalar", LONG_TYPE),
        ENCODED,
        RANGE,
        call("pandas DataFrame", number(0), HUGE),
        call("pandas Index", RANGE),
        call("pandas.core.indexes.base _new_Index", b"cpandas\nIndex\n", b"(S'data'\n(ld"),
    ],
    ids=["array", "reconstructed", "scalar", "encoded", "range", "table", "index", "index of a list"],
)
def test_what_would_take_more_memory_than_it_has_bytes_is_refused(made: bytes, tmp_path: Path) -> None:
    file = tmp_path / "large.pkl.gz"
    file.write_bytes(gzip.compress(made + b"."))
    before_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match=r"large\.pkl\.gz: cannot read it"):
        load_table(file)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kib < 200_000


def test_a_gzip_bomb_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "bomb.pkl.gz"
    file.write_bytes(gzip.compress(b"N0" * (MAX_UNZIPPED_BYTES // 2) + b"N."))  # push and pop nothing
    assert file.stat().st_size < 200_000
    with pytest.raises(InputError, match=r"bomb\.pkl\.gz: .*longer than"):
        load_table(file)


@pytest.mark.parametrize("protocol", [4, 5])
def test_tables_load_as_they_were(protocol: int, tmp_path: Path) -> None:
    """Texts as objects, as pandas before 3 stores them."""
    table = pd.DataFrame({"x": [1.5, 2.5], "n": [3, 4], "name": pd.Series(["a", "b"], dtype=object)})
    table.columns = table.columns.astype(object)
    for kept in (table, table.set_index(pd.Index([7, 5])), table.iloc[:0]):
        file = tmp_path / "table.pkl.gz"
        file.write_bytes(gzip.compress(pickle.dumps(kept, protocol=protocol)))
        loaded = load_table(file)
        assert type(loaded) is pd.DataFrame
        pd.testing.assert_frame_equal(loaded, kept)


@pytest.mark.parametrize("protocol", [2, 4, 5])
def test_tables_with_texts_of_arrow_load(protocol: int, tmp_path: Path) -> None:
    """As pandas 3 stores texts; a part of a larger table, and one without a value."""
    table = pd.DataFrame({"x": [1.5, 2.5, 3.5], "name": pd.Series(["a", None, "Straße"], dtype="str")})
    for kept in (table, table.iloc[1:], table.set_index("name"), table.iloc[:0]):
        file = tmp_path / "table.pkl.gz"
        file.write_bytes(gzip.compress(pickle.dumps(kept, protocol=protocol)))
        pd.testing.assert_frame_equal(load_table(file), kept)


def test_texts_that_point_out_of_their_bytes_are_refused(tmp_path: Path) -> None:
    table = pd.DataFrame({"name": pd.Series(["a", "bc"], dtype="str")})
    content = pickle.dumps(table, protocol=4)
    offsets = np.array([0, 1, 3], "<i8").tobytes()
    assert content.count(offsets) == 1
    file = tmp_path / "table.pkl.gz"
    far = np.array([0, 1, 10**9], "<i8").tobytes()
    file.write_bytes(gzip.compress(content.replace(offsets, far)))
    with pytest.raises(InputError, match="cannot read it as a pickle of plain data"):
        load_table(file)


def test_an_integer_index_of_pandas_1_loads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before pandas 2 it has a class of its own, which is gone."""
    old = types.ModuleType("pandas.core.indexes.numeric")
    old.Int64Index = type("Int64Index", (), {"__module__": old.__name__})  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, old.__name__, old)

    class Pickler(pickle.Pickler):
        def reducer_override(self, value: object) -> object:
            if isinstance(value, pd.Index) and value.dtype == np.int64:
                made, (_, state), *_ = value.__reduce__()
                return made, (old.Int64Index, state)
            return NotImplemented

    table = pd.DataFrame({"x": [1.5, 2.5]}, index=pd.Index([7, 5], name="n"))
    table.columns = table.columns.astype(object)
    out = io.BytesIO()
    Pickler(out, 2).dump(table)
    assert b"Int64Index" in out.getvalue()
    file = tmp_path / "table.pkl.gz"
    file.write_bytes(gzip.compress(out.getvalue()))
    monkeypatch.delitem(sys.modules, old.__name__)
    pd.testing.assert_frame_equal(load_table(file), table)
