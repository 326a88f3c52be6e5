"""The base class of sessions, which define the work of sandboxed processes."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import ClassVar

from pydantic import BaseModel


class Answer(BaseModel):
    """What every answer of a session holds; a session adds the results of each request."""

    warnings: list[str]


class Session:
    """The requests that a sandboxed process answers.

    The child makes one session, with the keyword arguments that the parent gives to
    `SandboxedProcess`. Each request calls the session's method of that name, which returns a dict
    that JSON can hold.

    Attributes
    ----------
    activities : mapping of str to str
        A phrase for each request, for messages such as "fitting took longer than the limit of 60
        s".
    answers : mapping of str to subclass of Answer
        Keys and types of the answers to requests that have results.
    """

    activities: ClassVar[Mapping[str, str]] = {}
    answers: ClassVar[Mapping[str, type[Answer]]] = {}

    @classmethod
    def preload(cls) -> None:
        """Import what sessions need. A fork server calls this once, before it forks."""

    @classmethod
    def path(cls) -> str:
        """Return the name that the child imports the class by, ``package.module:Class``."""
        return f"{cls.__module__}:{cls.__qualname__}"


def session_class(path: str) -> type[Session]:
    """Import the session class that `Session.path` names."""
    module, _, name = path.partition(":")
    found: type[Session] = getattr(import_module(module), name)
    return found
