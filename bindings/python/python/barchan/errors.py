"""Exceptions of Barchan: one tree, with the words of the simulator.

Every message says what is wrong, where, and how to mend it.
"""

from __future__ import annotations

__all__ = [
    "BarchanError",
    "BodyError",
    "BusyError",
    "CapacityError",
    "DeviceError",
    "DisplayError",
    "FileError",
    "PluginError",
    "SceneError",
    "SimulationError",
    "SnapshotError",
    "UnknownNameError",
]


class BarchanError(Exception):
    """Anything that Barchan refuses or cannot do."""

    world: int | None = None
    """Number of the world that it is about, where there are several."""


class BarchanWarning(UserWarning):
    """What the plan of a scene warns of: the scene runs, but maybe not as it is meant. ``Simulation.plan`` has it, too."""


class SceneError(BarchanError, ValueError):
    """A scene that cannot be used."""

    file: str = ""
    """The scene's file, "overrides", or "scene" for a dict."""
    line: int | None = None
    """Line in the file, from 1."""
    path: str = ""
    """Key path, such as ``body[0].shape.box.min``."""


class UnknownNameError(BarchanError, LookupError):
    """A name that nothing bears: of a scene, a material, a backend, an adapter."""

    known: list[str] = []
    """The names that there are."""


class PluginError(BarchanError):
    """A plugin that cannot be loaded, or lacks something that the scene calls for."""


class SimulationError(BarchanError, ArithmeticError):
    """A simulation that cannot go on: a time step above what is stable, numbers that are not finite, a particle that left the world."""


class BodyError(BarchanError, ValueError):
    """A body, a command to it, or a state, that does not fit."""


class DeviceError(BarchanError, RuntimeError):
    """A device that a backend runs on failed."""


class DisplayError(BarchanError, RuntimeError):
    """No window can be opened here."""


class SnapshotError(BarchanError, ValueError):
    """A snapshot that cannot be read or does not fit."""


class FileError(BarchanError, OSError):
    """A file or folder that cannot be read or written."""


class CapacityError(BarchanError, MemoryError):
    """More memory, particles or threads than there may be."""


class BusyError(BarchanError, RuntimeError):
    """A simulation that another thread is using."""
