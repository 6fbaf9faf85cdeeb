"""YAML from outside: aliases are allowed and bounded, no error but InputError leaves the reader."""

import ast
import re
from pathlib import Path

import pytest

import foredrive
from foredrive.errors import InputError
from foredrive.plain_yaml import MAX_BYTES, MAX_SCALAR, MAX_VALUES, parse_yaml, read_yaml


def laughing(doublings: int) -> str:
    """A list that aliases double; it stands for 2 + 2^doublings leaves and the lists around them."""
    lists = ["&z0 [x]", *(f"&z{k + 1} [*z{k}, *z{k}]" for k in range(doublings))]
    return f"[{', '.join(lists)}]"


def test_aliases_and_merged_keys_of_people_are_read() -> None:
    text = "a: &a {x: 1, y: [1, 2]}\nb: *a\nc: {<<: *a, x: 2}\n"
    plain = {"x": 1, "y": [1, 2]}
    assert parse_yaml(text) == {"a": plain, "b": plain, "c": plain | {"x": 2}}


def test_text_stays_as_it_is_written() -> None:
    assert parse_yaml("[0101, 1e05, null]", as_text=True) == ["0101", "1e05", "null"]
    assert parse_yaml("[0101, 1.0e+5, null]") == [65, 1e5, None]


def test_values_are_counted_as_often_as_aliases_repeat_them() -> None:
    """`&z0 [x]` is 2 values and each doubling 1 more than twice as many; all of them are in one list."""
    values, part = 1, 2
    for doublings in range(30):
        values += part
        if values > MAX_VALUES:
            break
        assert isinstance(parse_yaml(laughing(doublings)), list)
        part = 1 + 2 * part
    assert doublings == 15
    with pytest.raises(InputError, match="more than 100,000 values"):
        parse_yaml(laughing(doublings))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (laughing(60), "more than 100,000 values"),
        ("a: &a {b: *a}", "line 1: a value contains itself"),
        ("x: 1\na: {b: 1, b: 2}", "line 2: the key 'b' is given twice"),
        ("[" * 100_000, "nested too deeply"),
        ("a: 2001-13-45", "month must be in 1..12"),
        ("a: " + "9" * 5000, "Exceeds the limit"),
        ("a: 1" + ":59" * MAX_SCALAR, "a value of more than 10,000 characters"),
        ("!!python/object/apply:os.system [exit 7]", "could not determine a constructor"),
        ("a: [", "while parsing a flow node"),
        ("a: \x01", "unacceptable character"),
        ("{[a]: 1}", "while constructing a mapping"),
        ("a: 1\n---\nb: 2", "expected a single document"),
    ],
)
def test_what_is_not_plain_is_one_line(text: str, said: str) -> None:
    with pytest.raises(InputError, match=said) as caught:
        parse_yaml(text)
    assert "\n" not in str(caught.value)


def test_a_file_is_named_and_bounded(tmp_path: Path) -> None:
    file = tmp_path / "own.yaml"
    file.write_text("#" * MAX_BYTES)
    assert read_yaml(file) is None
    bad = {"longer than": b"#" * (MAX_BYTES + 1), "utf-8": b"\xff\xfe", "parsing": b"a: ["}
    for said, content in bad.items():
        file.write_bytes(content)
        with pytest.raises(InputError, match=rf"own\.yaml: not a recipe: .*{said}"):
            read_yaml(file, "a recipe")
    with pytest.raises(InputError, match="longer than"):
        read_yaml(Path("/dev/zero"))
    with pytest.raises(InputError, match=r"nowhere\.yaml: cannot be read: No such file"):
        read_yaml(tmp_path / "nowhere.yaml")


def test_nothing_else_loads_yaml() -> None:
    root, loads = Path(foredrive.__file__).parent, set[str]()
    for path in root.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Attribute) and re.match(r"yaml\..*[lL]oad", ast.unparse(node)):
                loads.add(path.relative_to(root).as_posix())
    assert loads == {"plain_yaml.py"}
