"""Lets a test raise an error in a function of a running process: once, at the place it names.

On the path of the processes of a test's room. The file named by AUTOSPINE_INJECT says what is to
happen: process (the subcommand), where (module:qualified name), error; it is renamed when it did.
"""

import functools
import importlib.abc
import importlib.machinery
import json
import os
import sqlite3
import sys
from pathlib import Path

_FILE = os.environ.get("AUTOSPINE_INJECT")


def _error(name):
    if name == "LinAlgError":
        from numpy.linalg import LinAlgError

        return LinAlgError("Singular matrix")
    return {
        "OSError": OSError(5, "Input/output error"),
        "TypeError": TypeError("unsupported operand"),
        "OperationalError": sqlite3.OperationalError("disk I/O error"),
    }[name]


def _due(where):
    path = Path(_FILE)
    try:
        wanted = json.loads(path.read_text())
    except (OSError, ValueError):
        return None
    if wanted["where"] != where or wanted["process"] not in sys.argv[1:2]:
        return None
    try:
        path.rename(path.with_suffix(".done"))
    except OSError:
        return None
    return _error(wanted["error"])


def _failing(function, where):
    @functools.wraps(function)
    def call(*args, **kwargs):
        error = _due(where)
        if error is not None:
            raise error
        return function(*args, **kwargs)

    return call


def _arm(module, places):
    for place in places:
        owner, _, name = place.rpartition(".")
        holder = getattr(module, owner) if owner else module
        function = getattr(holder, name)
        setattr(holder, name, _failing(function, f"{module.__name__}:{place}"))


class _Finder(importlib.abc.MetaPathFinder):
    def __init__(self, places):
        self._places = places

    def find_spec(self, name, path, target=None):
        if name not in self._places:
            return None
        spec = importlib.machinery.PathFinder.find_spec(name, path, target)
        if spec is None or spec.loader is None:
            return None
        run = spec.loader.exec_module

        def exec_module(module):
            run(module)
            _arm(module, self._places[name])

        spec.loader.exec_module = exec_module
        return spec


if _FILE:
    _places = {}
    for _line in Path(_FILE).with_name("boundaries.txt").read_text().split():
        _module, _, _place = _line.partition(":")
        _places.setdefault(_module, []).append(_place)
    sys.meta_path.insert(0, _Finder(_places))
