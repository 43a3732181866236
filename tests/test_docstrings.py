"""Every public name says what it is and what it takes."""

import importlib
import inspect
import pkgutil
from types import FunctionType

import pytest

import torchlb
from torchlb import interop

MIN_SUMMARY = 10  # characters
METHODS = (FunctionType, classmethod, staticmethod, property)


ADAPTERS = [
    importlib.import_module(f"torchlb.interop.{found.name}")
    for found in pkgutil.iter_modules(interop.__path__)
]


def public():
    """Public names, also of the adapters to other libraries, and what they stand for."""
    for module in [torchlb, *ADAPTERS]:
        for name in module.__all__:
            yield name, getattr(module, name)


def described():
    """Public classes and functions, and the methods the classes define: name and own docstring."""
    for name, value in public():
        if not (callable(value) or inspect.ismodule(value)):
            continue  # a constant
        yield pytest.param(name, value.__doc__, id=name)
        for key, member in vars(value).items() if inspect.isclass(value) else ():
            if not key.startswith("_") and isinstance(member, METHODS):
                yield pytest.param(key, member.__doc__, id=f"{name}.{key}")


def signatures():
    """Public functions and methods, and the __init__ of public classes."""
    for name, value in public():
        if inspect.isclass(value):
            for key, member in vars(value).items():
                member = getattr(member, "__func__", member)  # of a classmethod or staticmethod
                if inspect.isfunction(member) and (key == "__init__" or not key.startswith("_")):
                    yield pytest.param(member, id=f"{name}.{key}")
        elif callable(value):
            yield pytest.param(value, id=name)


@pytest.mark.parametrize(("name", "doc"), list(described()))
def test_public_name_has_a_summary(name, doc):
    summary = inspect.cleandoc(doc or "").partition("\n")[0]
    assert len(summary) >= MIN_SUMMARY
    assert not summary.startswith(f"{name}("), "a dataclass needs a docstring of its own"


@pytest.mark.parametrize("function", list(signatures()))
def test_public_function_annotates_every_parameter(function):
    missing = [
        parameter.name
        for parameter in inspect.signature(function).parameters.values()
        if parameter.annotation is parameter.empty and parameter.name not in ("self", "cls")
    ]
    assert not missing, f"{function.__qualname__} lacks types for {missing}"
