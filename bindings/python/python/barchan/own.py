"""Tasks of your own, written in Python, as environments of Gymnasium (`pip install 'barchan[gym]'`).

A subclass of `SceneVectorEnv` says what actions do in a scene, what is seen and what is rewarded. Worlds of one simulation, episodes, seeds, automatic resets, failures and
pictures are seen to.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from barchan._core import Simulation, State, View
from barchan._vector import Step, WorldsVectorEnv, checked_actions, reset_needed
from barchan.errors import BodyError, SimulationError

import gymnasium
from gymnasium.vector import AutoresetMode

__all__ = ["OneWorldEnv", "SceneVectorEnv"]

# Share of a control step by which the time of a world that has taken it may be off.
_ROUNDING = 1e-6


class SceneVectorEnv(WorldsVectorEnv):
    """Worlds of a scene as environments whose task a subclass says.

    In a control step `act` gives commands, all worlds go on for `interval`, and `observe`, `reward`, `terminated` and `info` are asked, in this order, once for all worlds: what
    they take and return has a row for each. They read `self.simulation`, a `barchan.Simulation`; `robot_arrays` and `body_arrays` have a row for each world, too. An episode
    begins with `draw`, `begin` and `observe`.

    Parameters
    ----------
    scene
        Name of a built-in scene, path of a scene's file, or a dict, as for `barchan.Simulation`.
    num_envs
        Number of worlds.
    interval
        Simulated time of a control step [s].
    max_episode_steps
        Control steps after which an episode is truncated.
    action_space
        Of one world. What lies beyond the limits of a `Box` is cut off, and `info["clipped"]` counts it.
    observation_space
        A `Box`, of one world.
    overrides
        Changes to the scene, as for `barchan.Simulation`: a dict, or one for each world.
    autoreset_mode
        "NextStep", "SameStep" or "Disabled", as for `TaskVectorEnv`.
    backend, precision, adapter, threads
        As for `barchan.Simulation`.
    torch
        What is returned are tensors of PyTorch: True, or the name of a device. Tensors are taken as actions anyway.
    failures
        "raise" an exception if a world cannot go on, or "end" its episode with a reward of 0, `info["failed"]`, and why in `failures`.
    """

    def __init__(
        self,
        scene: str | os.PathLike[str] | dict[str, Any],
        num_envs: int = 1,
        *,
        interval: float,
        max_episode_steps: int,
        action_space: gymnasium.Space[Any],
        observation_space: gymnasium.spaces.Box,
        overrides: dict[str, Any] | Sequence[dict[str, Any]] | None = None,
        render_mode: Literal["rgb_array"] | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        backend: str = "cpu",
        precision: Literal["f32", "f64"] = "f32",
        adapter: str | int | None = None,
        threads: int = 0,
        torch: bool | str = False,
        failures: Literal["raise", "end"] = "raise",
    ) -> None:
        if not (np.isfinite(interval) and interval > 0.0):
            raise ValueError(f"interval: {interval} is no time of a control step; give seconds above 0")
        if not isinstance(observation_space, gymnasium.spaces.Box):
            raise TypeError(f"observation_space: it is a {type(observation_space).__name__}; give a gymnasium.spaces.Box")
        if failures not in ("raise", "end"):
            raise ValueError(f"failures: {failures!r} is neither 'raise' nor 'end'")
        super().__init__(num_envs, action_space, observation_space, max_episode_steps, render_mode, autoreset_mode, torch)
        self.interval = float(interval)
        self.metadata = self.metadata | {"render_fps": round(min(60.0, 1.0 / interval)) or 1}
        self.failures: list[str | None] = [None] * num_envs
        """Why each world's last episode that failed did so, with failures="end"."""
        self._scene = scene
        self._overrides = overrides
        self._options: dict[str, Any] = {"backend": backend, "precision": precision, "adapter": adapter, "threads": threads}
        self._ends = failures == "end"
        self._simulation: Simulation | None = None
        # Where all episodes begin, if all begin alike.
        self._start: State | None = None
        self._generators: list[np.random.Generator] = [np.random.default_rng(0)] * num_envs
        self._changed: frozenset[str] | None = None
        self._views: dict[int, View] = {}
        self._steps = np.zeros(num_envs, np.int64)
        self._clipped = np.zeros(num_envs, np.int64)
        self._torn = False

    @property
    def simulation(self) -> Simulation:
        """The simulated worlds; there are none before the first reset."""
        if self._simulation is None:
            raise reset_needed()
        return self._simulation

    @property
    def steps_taken(self) -> NDArray[np.int64]:
        """Control steps that each world's episode has taken, (num_envs,)."""
        return self._steps.copy()

    def random(self, world: int) -> np.random.Generator:
        """The generator of an episode's random numbers, which begins from its seed."""
        return self._generators[world]

    # What a subclass says.

    def draw(self, random: np.random.Generator) -> dict[str, Any]:
        """What differs in a new episode's scene: overrides, the same keys each time.

        Without it worlds begin alike, with a copy. With it scenes are seeded anew, world w's with the scene's random seed plus w, unless this gives one (`"seed"`).
        """
        return {}

    def begin(self, worlds: list[int]) -> None:
        """Prepares new episodes in these worlds, which are at the scene's start: puts bodies elsewhere, sets back what the task remembers."""

    def act(self, actions: NDArray[Any]) -> None:
        """Gives the commands of a control step. Actions are float64 of shape (num_envs, ...), within the space."""
        raise NotImplementedError(f"{type(self).__name__} has no act(actions)")

    def observe(self) -> Any:
        """What is seen of every world, (num_envs, ...)."""
        raise NotImplementedError(f"{type(self).__name__} has no observe()")

    def reward(self, actions: NDArray[Any]) -> Any:
        """Reward of the control step that has just been taken, (num_envs,)."""
        raise NotImplementedError(f"{type(self).__name__} has no reward(actions)")

    def terminated(self) -> Any:
        """Does the episode end here by what has happened? Bools, (num_envs,). What lasts too long is truncated without asking."""
        return np.zeros(self.num_envs, np.bool_)

    def info(self) -> dict[str, Any]:
        """Numbers to tell by name, each (num_envs,)."""
        return {}

    def close_extras(self, **_: Any) -> None:
        self._simulation = self._start = None
        self._views.clear()

    # What the episodes ask for.

    def _begin(self, worlds: list[int], seeds: list[int]) -> NDArray[Any]:
        for world, seed in zip(worlds, seeds, strict=True):
            self._generators[world] = np.random.default_rng(seed)
        drawn = [self._drawn_scene(world) for world in worlds]
        if self._simulation is None:
            own = self._overrides if self._overrides is not None else {}
            each = [own] * self.num_envs if isinstance(own, dict) else list(own)
            if len(each) != self.num_envs:
                raise ValueError(f"overrides: there are {len(each)} of them for {self.num_envs} worlds")
            overrides = [before | more for before, more in zip(each, drawn, strict=True)]
            self._simulation = Simulation(self._scene, worlds=self.num_envs, overrides=overrides, **self._options)
            if isinstance(own, dict) and not self._changed:
                self._start = self._simulation.state()
                self._simulation.restore(self._start)
        elif self._start is not None:
            # Nothing is seeded then.
            self._simulation.restore(self._start, worlds=worlds)
        else:
            self._simulation.reset(worlds, overrides=drawn if self._changed else None)
        if len(worlds) == self.num_envs:
            self._torn = False
        self._steps[worlds], self._clipped[worlds] = 0, 0
        for world in worlds:
            self._views.pop(world, None)
        self.begin(worlds)
        return self._observed()

    def _play(self, actions: Any, waiting: NDArray[np.bool_]) -> Step:
        if self._torn:
            raise ValueError("a control step was interrupted half way; reset() all worlds first")
        given, beyond = self._checked(actions)
        self.act(given)
        going = ~waiting
        self._torn = True
        failed = self._go_on(going)
        self._torn = False
        self._steps[going] += 1
        self._clipped[going] += beyond[going]
        if not self._ends and failed:
            raise next(iter(failed.values()))
        is_failed = np.isin(np.arange(self.num_envs), list(failed))
        for world, error in failed.items():
            self.failures[world] = str(error)
        observations = self._observed()
        rewards = self._rows(self.reward(given), "reward", np.float64)
        rewards[is_failed] = 0.0
        terminated = self._rows(self.terminated(), "terminated", np.bool_) | is_failed
        told = {name: self._rows(values, f"info: {name}", None) for name, values in self.info().items()}
        told["clipped"] = self._clipped.copy()
        if self._ends:
            told["failed"] = is_failed
        return observations, rewards, terminated, np.zeros(self.num_envs, np.bool_), told

    def _go_on(self, going: NDArray[np.bool_]) -> dict[int, SimulationError]:
        """Worlds go on for a control step. Returns what those say that cannot."""
        until = self.simulation.times + self.interval
        try:
            self.simulation.advance(self.interval, worlds=np.flatnonzero(going).tolist())
        except SimulationError as error:
            first = error
        else:
            return {}
        failed = {}
        # Of several that cannot go on one has been raised: the others are asked again.
        for world in np.flatnonzero(going & (self.simulation.times < until - _ROUNDING * self.interval)).tolist():
            if first.world in (None, world):
                failed[world] = first
                continue
            try:
                self.simulation.advance(until[world] - self.simulation.times[world], worlds=[world])
            except SimulationError as error:
                failed[world] = error
        return failed

    def _taken(self) -> NDArray[np.int64]:
        return self._steps

    def _next_seed(self, before: int, random: np.random.Generator) -> int:
        differs = any(getattr(type(self), name) is not getattr(SceneVectorEnv, name) for name in ("draw", "begin"))
        return int(random.integers(2**31)) if differs or before < 0 else before

    def _is_begun(self) -> bool:
        return self._simulation is not None

    def _picture(self, world: int) -> NDArray[np.uint8]:
        if world not in self._views:
            self._views[world] = View(self.simulation, world=world)
        return self._views[world].draw(self.simulation, world=world)

    def _drawn_scene(self, world: int) -> dict[str, Any]:
        drawn = dict(self.draw(self._generators[world]))
        # A key that is left out would keep what the episode before has set.
        if self._changed is not None and self._changed != drawn.keys():
            raise ValueError(f"draw: it gave {sorted(self._changed)} before and gives {sorted(drawn)} now; give the same keys each time")
        self._changed = frozenset(drawn)
        return drawn

    def _checked(self, actions: Any) -> tuple[NDArray[Any], NDArray[np.int64]]:
        """Actions within their space, and how many numbers of each world's were beyond."""
        space = self.single_action_space
        if not isinstance(space, gymnasium.spaces.Box):
            given = np.asarray(actions.detach().cpu().numpy() if hasattr(actions, "detach") else actions)
            if not self.action_space.contains(given):
                raise BodyError(f"action: {given!r} is none of {self.action_space}")
            return given, np.zeros(self.num_envs, np.int64)
        given = checked_actions(actions, (self.num_envs, *space.shape), None, space.low, space.high)
        beyond = (given < space.low) | (given > space.high)
        return np.clip(given, space.low, space.high), beyond.reshape(self.num_envs, -1).sum(axis=1)

    def _observed(self) -> NDArray[Any]:
        space = self.single_observation_space
        seen = np.array(self.observe(), space.dtype)
        if seen.shape != (self.num_envs, *space.shape):
            raise ValueError(f"observe: it returns an array of shape {seen.shape}; return one of {(self.num_envs, *space.shape)}")
        return seen

    def _rows(self, values: Any, name: str, dtype: Any) -> NDArray[Any]:
        rows = np.array(values, dtype)
        if rows.shape != (self.num_envs,):
            raise ValueError(f"{name}: it is an array of shape {rows.shape}; return one of ({self.num_envs},), a number for each world")
        return rows


class OneWorldEnv(gymnasium.Env):
    """The only world of a vector as an environment of its own, for what takes no vectors: `OneWorldEnv(MyTask(1, autoreset_mode="Disabled"))`."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}

    def __init__(self, vector: WorldsVectorEnv) -> None:
        if vector.num_envs != 1 or vector.autoreset_mode is not AutoresetMode.DISABLED:
            what = f"it has num_envs={vector.num_envs} and autoreset_mode={vector.autoreset_mode.value!r}"
            raise ValueError(f"vector: {what}; give one with num_envs=1 and autoreset_mode='Disabled'")
        self.vector = vector
        self.action_space = vector.single_action_space
        self.observation_space = vector.single_observation_space
        self.render_mode = vector.render_mode
        self.metadata = self.metadata | {"render_fps": vector.metadata["render_fps"]}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        observations, info = self.vector.reset(seed=seed, options=options)
        return observations[0], _of_one(info)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observations, rewards, terminated, truncated, info = self.vector.step(action[None] if hasattr(action, "shape") else np.asarray(action)[None])
        return observations[0], float(rewards[0]), bool(terminated[0]), bool(truncated[0]), _of_one(info)

    def render(self) -> NDArray[np.uint8] | None:
        pictures = self.vector.render()
        return None if pictures is None else pictures[0]

    def close(self) -> None:
        self.vector.close()


def _of_one(info: dict[str, Any]) -> dict[str, Any]:
    return {name: values[0].item() for name, values in info.items() if not name.startswith("_")}
