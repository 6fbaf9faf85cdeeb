"""Packages that import on demand offer what they say, and nothing else."""

import importlib

import pytest


@pytest.mark.parametrize("package", ["training", "evaluation", "recipes", "runs"])
def test_what_a_package_offers_is_there(package: str) -> None:
    module = importlib.import_module(f"foredrive.{package}")
    assert all(getattr(module, name) is not None for name in module.__all__)
    with pytest.raises(AttributeError, match=f"foredrive.{package}' has no attribute 'no_such_thing'"):
        _ = module.no_such_thing
