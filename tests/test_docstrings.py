"""Every public name says what it is and what it takes."""

import importlib
import inspect
import logging
import pkgutil
import re
from types import FunctionType

import griffe

import torchlb
from torchlb import interop

MIN_SUMMARY = 10  # characters
REFUSED = [  # whatever is given there is an error
    ("LaplaceBeltrami.__init__", "given"),
    ("LaplaceBeltrami.from_points", "surplus"),
]
METHODS = (FunctionType, classmethod, staticmethod, property)
MODULES = [torchlb] + [
    importlib.import_module(f"torchlb.interop.{found.name}")
    for found in pkgutil.iter_modules(interop.__path__)
]


def public():
    """Public names, also of the adapters to other libraries, and what they stand for; those of classes as A.b."""
    for module in MODULES:
        for name in module.__all__:
            value = getattr(module, name)
            yield name, value
            for key, member in vars(value).items() if inspect.isclass(value) else ():
                if isinstance(member, METHODS) and (key == "__init__" or not key.startswith("_")):
                    yield f"{name}.{key}", member


def test_every_public_name_has_a_summary():
    poor = []
    for name, value in public():
        described = callable(value) or inspect.ismodule(value) or isinstance(value, METHODS)
        if described and not name.endswith(".__init__"):  # the class says what that takes
            summary = inspect.cleandoc(value.__doc__ or "").partition("\n")[0]
            if len(summary) < MIN_SUMMARY or summary.startswith(f"{name}("):  # made by dataclass
                poor.append(f"{name}: {summary!r}")
    assert not poor


def test_every_parameter_of_a_public_function_has_a_type():
    missing = [
        f"{name}({parameter.name})"
        for name, value in public()
        if inspect.isfunction(function := getattr(value, "__func__", value))
        for parameter in inspect.signature(function).parameters.values()
        if parameter.annotation is parameter.empty and parameter.name not in ("self", "cls")
    ]
    assert not missing


def described(value):
    """Names in a docstring's lists, as the API pages parse it; and its prose, for what is explained there."""
    doc = inspect.cleandoc(value.__doc__ or "")
    logging.getLogger("griffe").setLevel(logging.ERROR)
    names = {
        name.strip(" *")
        for section in griffe.Docstring(doc, parser="numpy").parse()
        if section.kind.value in ("parameters", "attributes")
        for entry in section.value
        if entry.description.strip()
        for name in entry.name.split(",")
    }
    return names, re.split(r"Examples\n|>>>", doc)[0]


def test_every_parameter_of_a_public_function_is_described():
    """In a list or in prose, of its own, of its class, or of the function that it says to be like."""
    missing, classes = [], dict(public())
    for name, value in public():
        function = getattr(value, "__func__", value)
        if not inspect.isfunction(function):
            continue
        names, prose = described(function)
        if name.endswith(".__init__"):
            names |= described(classes[name.rpartition(".")[0]])[0]
        if re.search(r"(?i)(as for|those of|^as) `", prose):
            continue
        missing += [
            f"{name}({parameter})"
            for parameter in inspect.signature(function).parameters
            if parameter not in names | {"self", "cls"}
            and (name, parameter) not in REFUSED
            and not re.search(rf"(?<![\w.]){parameter}(?![\w(])", prose)
        ]
    assert not missing
