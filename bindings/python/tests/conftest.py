"""Scenes that are ready within seconds."""

import signal

import numpy as np
import pytest

import barchan

# What a shell starts in the background ignores Ctrl-C, and so would the calls that are to be ended by it.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture
def press():
    """A plate above a block of snow; a dict, made anew for each test."""
    return {
        "name": "press",
        "world": {"cell": 0.05, "min": [0, 0, 0], "max": np.array([0.4, 0.4, 0.4]), "walls": {"z_min": "stick"}},
        "time": {"end": 0.2},
        "material": [{"name": "snow", "law": "snow", "density": 400.0}],
        "body": [{"material": "snow", "sampling": "jitter", "shape": {"box": {"min": (0.1, 0.1, 0), "max": (0.3, 0.3, 0.2)}}}],
        "tool": [
            {"name": "plate", "shape": {"box": {"half": [0.1, 0.1, 0.02]}}, "position": [0.2, 0.2, 0.23], "motion": {"velocity": {}}},
        ],
    }


@pytest.fixture
def dog():
    """The quadruped above a floor."""
    robot = {"name": "dog", "model": "quadruped", "position": [0.0, 0.0, 1.0], "motor": [{"kp": 100.0, "kd": 3.0}]}
    robot["scan"] = {"min": [-0.3, -0.2], "max": [0.3, 0.2], "points": [3, 2]}
    world = {"cell": 0.1, "min": [-1, -1, 0], "max": [1, 1, 2], "walls": {"z_min": "stick"}}
    return barchan.Simulation({"name": "fall", "world": world, "time": {"end": 0.1, "step": 1e-3}, "robot": [robot]})


@pytest.fixture
def same():
    """Are two worlds the same, bit for bit?"""

    def compare(a, b, *, a_world=0, b_world=0):
        a, b = a.particles("velocity", "affine", "id", world=a_world), b.particles("velocity", "affine", "id", world=b_world)
        return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ("position", "velocity", "affine", "id"))

    return compare
