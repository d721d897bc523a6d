"""Barchan simulates robots on and in soft ground: sand, snow, elastic and elastoplastic bodies, coupled with rigid tools and robots.

>>> import barchan
>>> simulation = barchan.Simulation("dig", overrides={"world.cell": 0.05})
>>> simulation.advance(0.1)
>>> simulation.wrenches()["blade"].force.shape
(3,)

`Simulation` steps scenes and tells what happens in them, `Environment` worlds of a benchmark task; `barchan.envs` has the tasks for Gymnasium. `barchan.view` draws;
`barchan.records` holds what simulations say, and `barchan.errors` what they refuse.
"""

from barchan._core import Environment, Gradient, Simulation, State, Tape, __version__, adapters, add_material, load_plugin, registry, scenes, task
from barchan.errors import (
    BarchanError,
    BarchanWarning,
    BodyError,
    BusyError,
    CapacityError,
    DeviceError,
    DisplayError,
    FileError,
    PluginError,
    SceneError,
    SimulationError,
    SnapshotError,
    UnknownNameError,
)

__all__ = [
    "BarchanError",
    "BarchanWarning",
    "BodyError",
    "BusyError",
    "CapacityError",
    "DeviceError",
    "DisplayError",
    "Environment",
    "FileError",
    "Gradient",
    "PluginError",
    "SceneError",
    "Simulation",
    "SimulationError",
    "SnapshotError",
    "State",
    "Tape",
    "UnknownNameError",
    "__version__",
    "add_material",
    "adapters",
    "load_plugin",
    "registry",
    "scenes",
    "task",
]
